//! `segwild bench studio`: what a person waits for on the page.

use super::command_line::command_line;
use crate::args::{examples, path, path_of};
use crate::exit;
use crate::failure::Failure;
use crate::output::print_line;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::record::Provenance;
use segwild_eval::stamp;
use segwild_monitor::view::RunView;
use segwild_studio::{ServeOptions, StudioServer, serve};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Photos and pixels of them that are pointed at.
const HOVERED: [usize; 2] = [5, 8];

/// Clients that hover at a time, and requests of each.
const CROWD: [usize; 2] = [50, 4];

/// Frames of which the rate is the mean.
const FRAMES: usize = 12;

/// Sides of those frames.
const FRAME: [u32; 2] = [640, 480];

/// Time after which nothing is waited for.
const LONGEST: Duration = Duration::from_secs(120);

/// The benchmark's arguments.
pub fn command() -> Command {
    Command::new("studio")
        .about("What a person waits for on the page: photos, candidates, answers, frames; and its memory")
        .arg(
            Arg::new("runs")
                .required(true)
                .num_args(1..)
                .value_name("RUN")
                .value_parser(value_parser!(PathBuf))
                .help("Trained runs"),
        )
        .arg(path("page", "Write the page to this file as well"))
        .after_help(examples(
            "segwild bench studio runs/trevi",
            "segwild bench studio runs/trevi --page studio.md",
        ))
}

/// Measures each run, and prints the page.
pub fn studio(matches: &ArgMatches) -> Result<(), Failure> {
    let runs: Vec<PathBuf> = matches.get_many("runs").expect("clap requires it").cloned().collect();
    let mut rows = String::new();
    for run in &runs {
        rows += &StudioFigures::measure(run)?.row(run);
    }
    let made = Provenance::here(command_line());
    let text = format!(
        "# What a person waits for on the page (built-in)\n\nThis page is generated. {}\n\nTimes are those of requests to a server in the same \
         process, over HTTP, without a browser: median, and in brackets the slowest. *Hover*: the candidate under the pointer, in photos that \
         were opened before. *First answer*: from a click to splats that can be shown; *last*: refined by all photos. Clicks are on the parts \
         that the scene lists. Memory is the most that the process had so far, over all runs above. Frames have {} x {} pixels and are rendered by the server.\n\n\
         | run | splats | photos | s to the first photo | to the first frame | ms of a hover | of {} clients that hover at once | s to the first \
         answer | to the last | frames a second | MiB | of the run's own |\n|---|---:|---:|---:|---:|---|---|---|---|---:|---:|---:|\n{rows}",
        stamp::stamp(&made, &["built-in"]),
        FRAME[0],
        FRAME[1],
        CROWD[0],
    );
    if let Some(page) = path_of(matches, "page") {
        segwild_flow::files::write_plain(&page, &text)?;
    }
    print_line(text.trim_end())
}

/// What one run costs.
struct StudioFigures {
    splats: usize,
    photos: usize,
    first_photo_s: f64,
    first_frame_s: f64,
    hover_ms: Vec<f64>,
    crowd_ms: Vec<f64>,
    first_answer_s: Vec<f64>,
    last_answer_s: Vec<f64>,
    frames_per_s: f64,
    /// Bytes in memory at most, of this process and of the run.
    memory: [Option<u64>; 2],
}

impl StudioFigures {
    fn measure(run: &Path) -> Result<StudioFigures, Failure> {
        let began = Instant::now();
        let client = Client::new(run)?;
        let description = client.description()?;
        let of_client = client.get("photos/0?size=1280")?;
        let first_photo_s = began.elapsed().as_secs_f64();
        if of_client.is_empty() {
            return Err(failed("the photo is empty"));
        }
        let photos = description["photos"].as_array().cloned().unwrap_or_default();
        let view = |photo: usize| {
            let photo = &photos[photo % photos.len()];
            json!({ "camera": scaled(&photo["camera"]), "rotation": photo["rotation"], "translation": photo["translation"], "marks": true })
        };
        client.post("frame", &view(0))?;
        let first_frame_s = began.elapsed().as_secs_f64();
        let hover = |photo: usize, k: usize| {
            let camera = &photos[photo]["camera"];
            let at = |side: &str, share: f64| camera[side].as_f64().unwrap_or(1.0) * share;
            let (x, y) = (at("width", 0.2 + 0.07 * k as f64), at("height", 0.25 + 0.06 * k as f64));
            timed(|| client.post("hover", &json!({ "photo": photo, "x": x, "y": y })).map(drop))
        };
        let mut hover_ms = Vec::new();
        for photo in 0..HOVERED[0].min(photos.len()) {
            // The first time in a photo renders its map.
            hover(photo, 0)?;
            for k in 0..HOVERED[1] {
                hover_ms.push(1000.0 * hover(photo, k)?);
            }
        }
        let crowd_ms = std::thread::scope(|scope| {
            let one =
                |_| scope.spawn(|| (0..CROWD[1]).map(|k| hover(0, k)).collect::<Result<Vec<f64>, Failure>>());
            let all: Vec<_> = (0..CROWD[0]).map(one).collect();
            let joined = all.into_iter().map(|one| one.join().expect("a client does not panic"));
            joined.collect::<Result<Vec<_>, Failure>>()
        })?;
        let (mut first_answer_s, mut last_answer_s) = (Vec::new(), Vec::new());
        for part in description["listed"].as_array().into_iter().flatten().take(8) {
            let photo = part["photo"].as_u64().unwrap_or(0) as usize;
            let Some([x, y]) = client.pixel_of(part, &photos[photo])? else { continue };
            let prompt = json!({ "photo": photo, "points": [{ "x": x, "y": y, "inside": true }] });
            let (first, last) = client.click(&prompt)?;
            first_answer_s.push(first);
            last_answer_s.push(last);
        }
        let frames = Instant::now();
        for k in 0..FRAMES {
            client.post("frame", &view(k))?;
        }
        let frames_per_s = FRAMES as f64 / frames.elapsed().as_secs_f64();
        let own = RunView::read(run, 0.0).ok().and_then(|view| view.peak_rss_bytes);
        Ok(StudioFigures {
            splats: description["splats"].as_u64().unwrap_or(0) as usize,
            photos: photos.len(),
            first_photo_s,
            first_frame_s,
            hover_ms,
            crowd_ms: crowd_ms.concat().iter().map(|s| 1000.0 * s).collect(),
            first_answer_s,
            last_answer_s,
            frames_per_s,
            memory: [segwild_flow::cpu::peak_memory(), own],
        })
    }

    fn row(&self, run: &Path) -> String {
        let spread = |values: &[f64], digits: usize| {
            let mut sorted = values.to_vec();
            sorted.sort_by(f64::total_cmp);
            match sorted.as_slice() {
                [] => "-".into(),
                all => format!("{:.digits$} ({:.digits$})", all[all.len() / 2], all[all.len() - 1]),
            }
        };
        let [here, own] = self.memory.map(|bytes| bytes.map(|b| b as f64 / f64::from(1 << 20)));
        let number =
            |value: Option<f64>, digits: usize| value.map_or("-".into(), |v| format!("{v:.digits$}"));
        let mut row = String::new();
        let _ = writeln!(
            row,
            "| {} | {} | {} | {:.2} | {:.2} | {} | {} | {} | {} | {:.1} | {} | {} |",
            run.file_name().unwrap_or_default().display(),
            self.splats,
            self.photos,
            self.first_photo_s,
            self.first_frame_s,
            spread(&self.hover_ms, 0),
            spread(&self.crowd_ms, 0),
            spread(&self.first_answer_s, 2),
            spread(&self.last_answer_s, 1),
            self.frames_per_s,
            number(here, 0),
            number(here.zip(own).map(|(here, own)| here / own), 2),
        );
        row
    }
}

/// A camera at the frames' size.
fn scaled(camera: &Value) -> Value {
    let number = |key: &str| camera[key].as_f64().unwrap_or(1.0);
    let s = (f64::from(FRAME[0]) / number("width")).min(f64::from(FRAME[1]) / number("height"));
    json!({
        "width": FRAME[0], "height": FRAME[1], "fx": s * number("fx"), "fy": s * number("fy"),
        "cx": s * number("cx") + (f64::from(FRAME[0]) - s * number("width")) / 2.0,
        "cy": s * number("cy") + (f64::from(FRAME[1]) - s * number("height")) / 2.0,
    })
}

fn timed(work: impl FnOnce() -> Result<(), Failure>) -> Result<f64, Failure> {
    let began = Instant::now();
    work()?;
    Ok(began.elapsed().as_secs_f64())
}

fn failed(message: impl Into<String>) -> Failure {
    Failure { message: message.into(), code: exit::FAILED }
}

/// A client of a server in this process.
struct Client {
    server: StudioServer,
    base: String,
}

impl Client {
    fn new(run: &Path) -> Result<Client, Failure> {
        let server = serve(run, ServeOptions::default())?;
        let name = run.canonicalize()?.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Client { server, base: format!("/api/v1/runs/{name}") })
    }

    /// Sends a request; the answer's code and body.
    fn request(&self, method: &str, path: &str, body: &[u8]) -> Result<(u16, Vec<u8>), Failure> {
        let (host, token) = (self.server.socket(), self.server.token().text());
        let mut stream = TcpStream::connect(host)?;
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\nAuthorization: Bearer {token}\r\nContent-Length: {}\r\n\r\n",
            body.len()
        );
        stream.write_all(&[head.as_bytes(), body].concat())?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        let end =
            answer.windows(4).position(|four| four == b"\r\n\r\n").ok_or_else(|| failed("no answer"))?;
        let code = answer.get(9..12).and_then(|code| std::str::from_utf8(code).ok()?.parse().ok());
        Ok((code.ok_or_else(|| failed("no answer"))?, answer[end + 4..].to_vec()))
    }

    fn answered(&self, method: &str, path: &str, body: &[u8]) -> Result<Vec<u8>, Failure> {
        match self.request(method, &format!("{}/{path}", self.base), body)? {
            (200, body) => Ok(body),
            (code, body) => Err(failed(format!("{path}: {code}: {}", String::from_utf8_lossy(&body)))),
        }
    }

    fn get(&self, path: &str) -> Result<Vec<u8>, Failure> {
        self.answered("GET", path, b"")
    }

    fn post(&self, path: &str, body: &Value) -> Result<Vec<u8>, Failure> {
        self.answered("POST", path, body.to_string().as_bytes())
    }

    fn json(&self, bytes: &[u8]) -> Result<Value, Failure> {
        serde_json::from_slice(bytes).map_err(|e| failed(e.to_string()))
    }

    /// The run, as soon as its session is open.
    fn description(&self) -> Result<Value, Failure> {
        let began = Instant::now();
        while began.elapsed() < LONGEST {
            let (code, body) = self.request("GET", &self.base, b"")?;
            match code {
                200 => return self.json(&body),
                202 => std::thread::park_timeout(Duration::from_millis(5)),
                _ => return Err(failed(String::from_utf8_lossy(&body))),
            }
        }
        Err(failed("the session was not opened"))
    }

    /// A pixel deep inside of a listed part in the photo that shows it best: the middle of its longest run of pixels.
    fn pixel_of(&self, part: &Value, photo: &Value) -> Result<Option<[f64; 2]>, Failure> {
        self.post("act", &json!({ "do": "listed", "number": part["number"] }))?;
        self.wait()?;
        let map = self.json(&self.get(&format!("photos/{}/labels", part["photo"]))?)?;
        self.post("act", &json!({ "do": "prompt", "prompts": [] }))?;
        let side = |key: &str| map[key].as_u64().unwrap_or(1);
        let (mut at, mut best) = (0, (0, 0));
        let runs: Vec<u64> = map["runs"].as_array().into_iter().flatten().filter_map(Value::as_u64).collect();
        for run in runs.chunks_exact(2) {
            if run[0] == u64::from(segwild_studio::messages::ANSWER_LABEL) && run[1] > best.0 {
                best = (run[1], at + run[1] / 2);
            }
            at += run[1];
        }
        let full = |key: &str| photo["camera"][key].as_f64().unwrap_or(1.0);
        let (column, row) = (best.1 % side("width"), best.1 / side("width"));
        let share = |at: u64, key: &str| (at as f64 + 0.5) / side(key) as f64 * full(key);
        Ok((best.0 > 0).then(|| [share(column, "width"), share(row, "height")]))
    }

    /// Waits for the present answer; seconds until there were splats, and until it was the last.
    fn wait(&self) -> Result<(Option<f64>, f64), Failure> {
        let (began, mut first) = (Instant::now(), None);
        while began.elapsed() < LONGEST {
            let state = self.json(&self.get("state")?)?;
            let answer = &state["answer"];
            if answer["splats"].as_u64().unwrap_or(0) > 0 {
                first.get_or_insert(began.elapsed().as_secs_f64());
            }
            if answer["state"] != "working" {
                return Ok((first, began.elapsed().as_secs_f64()));
            }
            std::thread::park_timeout(Duration::from_millis(2));
        }
        Err(failed("the answer was not ready in time"))
    }

    /// Clicks; seconds to the first answer and to the last.
    fn click(&self, prompt: &Value) -> Result<(f64, f64), Failure> {
        self.post("act", &json!({ "do": "prompt", "prompts": [prompt] }))?;
        let (first, last) = self.wait()?;
        self.post("act", &json!({ "do": "prompt", "prompts": [] }))?;
        Ok((first.unwrap_or(last), last))
    }
}
