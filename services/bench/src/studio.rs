//! What a person waits for on the page: a client of its server, which measures requests one after the other and many at once.

use crate::page::{PageError, io};
use segwild_eval::record::{Record, Results};
use segwild_eval::stamp::{self, providers};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::time::{Duration, Instant};

/// The protocol under which everything here is recorded.
pub const PROTOCOL: &str = "studio";

/// Photos and pixels of them that are pointed at.
const HOVERED: [usize; 2] = [5, 8];

/// Clients that hover at a time, and requests of each.
const CROWD: [usize; 2] = [50, 4];

/// Frames of which the rate is the mean.
const FRAMES: usize = 12;

/// Sides of those frames.
const FRAME: [u32; 2] = [640, 480];

/// Parts of the scene that are clicked at most.
const CLICKED: usize = 8;

/// Time after which nothing is waited for.
const LONGEST: Duration = Duration::from_secs(120);

/// A run on a page that is served.
#[derive(Clone, Debug)]
pub struct StudioTarget {
    /// Where the server listens.
    pub address: SocketAddr,
    /// The token that it wants.
    pub token: String,
    /// The run's name in its addresses.
    pub run: String,
    /// The label of the answer's pixels in a photo's labels.
    pub answer_label: u8,
    /// When the server was started: the first photo and frame are timed from here.
    pub started: Instant,
}

/// Why a page could not be measured.
#[derive(Debug, thiserror::Error)]
pub enum StudioBenchError {
    /// The server cannot be reached.
    #[error("the page cannot be reached: {0}")]
    Connection(#[from] std::io::Error),
    /// The server refuses, or does not answer as it should.
    #[error("{path}: {reason}")]
    Answer {
        /// The request.
        path: String,
        /// What is wrong.
        reason: String,
    },
    /// Something took too long.
    #[error("{0} was not ready within {limit} s", limit = LONGEST.as_secs())]
    Late(&'static str),
}

/// What one run costs.
#[derive(Clone, Debug, PartialEq)]
pub struct StudioFigures {
    /// Who makes the masks of clicks: `built-in`, or `sam:` and a model's name.
    pub provider: String,
    /// Splats of the run.
    pub splats: usize,
    /// Its photos.
    pub photos: usize,
    /// Seconds to the first photo.
    pub first_photo_s: f64,
    /// Seconds to the first frame.
    pub first_frame_s: f64,
    /// Milliseconds of each hover.
    pub hover_ms: Vec<f64>,
    /// The same for many clients at once.
    pub crowd_ms: Vec<f64>,
    /// Seconds from each click to splats that can be shown.
    pub first_answer_s: Vec<f64>,
    /// Seconds to the last answer.
    pub last_answer_s: Vec<f64>,
    /// Seconds until it is known how sure that is.
    pub sure_s: Vec<f64>,
    /// Frames a second.
    pub frames_per_s: f64,
}

/// A run's figures, and the memory that serving it took.
#[derive(Clone, Debug, PartialEq)]
pub struct StudioRow {
    /// The run's name.
    pub run: String,
    /// What was measured.
    pub figures: StudioFigures,
    /// Most bytes in memory, of the server's process and of the run's.
    pub memory: [Option<u64>; 2],
}

impl StudioRow {
    /// The row as a record, in the units of its figures and in MiB: `server_mib` of the server's process and `run_mib` of the
    /// run's. Of what is measured many times it has the median, and the slowest under the same name after `slowest_`. The run's
    /// splats are `scene_splats`: they describe the scene, while `splats` is a cost of a training that is compared.
    pub fn record(&self) -> Record {
        let figures = &self.figures;
        let single = [
            ("scene_splats", figures.splats as f64),
            ("photos", figures.photos as f64),
            ("first_photo_s", figures.first_photo_s),
            ("first_frame_s", figures.first_frame_s),
            ("frames_per_s", figures.frames_per_s),
        ];
        let repeated = [
            ("hover_ms", &figures.hover_ms),
            ("crowd_hover_ms", &figures.crowd_ms),
            ("first_answer_s", &figures.first_answer_s),
            ("last_answer_s", &figures.last_answer_s),
            ("sure_s", &figures.sure_s),
        ];
        let mut numbers: BTreeMap<String, f64> =
            single.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
        for (name, values) in repeated {
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            if let Some(slowest) = sorted.last() {
                numbers.insert(name.to_owned(), sorted[sorted.len() / 2]);
                numbers.insert(format!("slowest_{name}"), *slowest);
            }
        }
        for (name, bytes) in ["server_mib", "run_mib"].into_iter().zip(self.memory) {
            numbers.extend(bytes.map(|bytes| (name.to_owned(), bytes as f64 / f64::from(1 << 20))));
        }
        let (protocol, scene, provider) = (PROTOCOL.into(), self.run.clone(), figures.provider.clone());
        Record { protocol, scene, setting: "page".into(), provider, numbers, ..Record::default() }
    }
}

/// Measures a run.
///
/// # Errors
/// When the server cannot be reached, refuses, or takes too long.
pub fn studio(target: &StudioTarget) -> Result<StudioFigures, StudioBenchError> {
    let client = StudioClient { target, base: format!("/api/v1/runs/{}", target.run) };
    let description = client.description()?;
    let first = client.get("photos/0?size=1280")?;
    let first_photo_s = target.started.elapsed().as_secs_f64();
    let photos = description["photos"].as_array().cloned().unwrap_or_default();
    if first.is_empty() || photos.is_empty() {
        return Err(refused("photos/0", "there is no photo"));
    }
    let view = |photo: usize| {
        let photo = &photos[photo % photos.len()];
        json!({ "camera": scaled(&photo["camera"]), "rotation": photo["rotation"], "translation": photo["translation"], "marks": true })
    };
    client.post("frame", &view(0))?;
    let first_frame_s = target.started.elapsed().as_secs_f64();
    let hover = |photo: usize, k: usize| -> Result<f64, StudioBenchError> {
        let camera = &photos[photo]["camera"];
        let at = |side: &str, share: f64| camera[side].as_f64().unwrap_or(1.0) * share;
        let (x, y) = (at("width", 0.2 + 0.07 * k as f64), at("height", 0.25 + 0.06 * k as f64));
        let began = Instant::now();
        client.post("hover", &json!({ "photo": photo, "x": x, "y": y }))?;
        Ok(1000.0 * began.elapsed().as_secs_f64())
    };
    let mut hover_ms = Vec::new();
    for photo in 0..HOVERED[0].min(photos.len()) {
        // The first time in a photo renders its map.
        hover(photo, 0)?;
        for k in 0..HOVERED[1] {
            hover_ms.push(hover(photo, k)?);
        }
    }
    let crowd_ms = std::thread::scope(|scope| {
        let one = |_| {
            scope.spawn(|| (0..CROWD[1]).map(|k| hover(0, k)).collect::<Result<Vec<f64>, StudioBenchError>>())
        };
        let all: Vec<_> = (0..CROWD[0]).map(one).collect();
        let joined = all.into_iter().map(|one| one.join().expect("a client does not panic"));
        joined.collect::<Result<Vec<_>, StudioBenchError>>()
    })?;
    let (mut first_answer_s, mut last_answer_s, mut sure_s) = (Vec::new(), Vec::new(), Vec::new());
    for part in description["listed"].as_array().into_iter().flatten().take(CLICKED) {
        let photo = part["photo"].as_u64().unwrap_or(0) as usize;
        let Some(shown) = photos.get(photo) else {
            return Err(refused(
                &client.base,
                format!("a part is listed in photo {photo} of {}", photos.len()),
            ));
        };
        let Some([x, y]) = client.pixel_of(part, shown)? else { continue };
        let prompt = json!({ "photo": photo, "points": [{ "x": x, "y": y, "inside": true }] });
        let timed = client.click(&prompt)?;
        first_answer_s.push(timed.first_s);
        last_answer_s.push(timed.last_s);
        sure_s.push(timed.sure_s);
    }
    let frames = Instant::now();
    for k in 0..FRAMES {
        client.post("frame", &view(k))?;
    }
    Ok(StudioFigures {
        provider: description["provider"].as_str().unwrap_or_default().to_owned(),
        splats: description["splats"].as_u64().unwrap_or(0) as usize,
        photos: photos.len(),
        first_photo_s,
        first_frame_s,
        hover_ms,
        crowd_ms: crowd_ms.concat(),
        first_answer_s,
        last_answer_s,
        sure_s,
        frames_per_s: FRAMES as f64 / frames.elapsed().as_secs_f64(),
    })
}

/// The figures of runs as a page.
pub fn page(results: &Results) -> String {
    let by = providers([results]);
    let mut text = format!(
        "# {}\n\nThis page is generated. {}\n\nTimes are those of requests to a server in the same \
         process, over HTTP, without a browser: median, and in brackets the slowest. *Hover*: the candidate under the pointer, in photos that \
         were opened before. *First answer*: from a click to splats that can be shown; *last*: refined by all photos; \
         *how sure*: until that is known of it. Clicks are on the parts that the scene lists. Memory is the most that the process had so far, \
         over all runs above. Frames have {} x {} pixels and are rendered by the server.\n\n\
         | run | splats | photos | s to the first photo | to the first frame | ms of a hover | of {} clients that hover at once | s to the first \
         answer | to the last | to how sure it is | frames a second | MiB | of the run's own |\n|---|---:|---:|---:|---:|---|---|---|---|---|---:|---:|---:|\n",
        stamp::title("What a person waits for on the page", &by),
        stamp::stamp(&results.made, &by),
        FRAME[0],
        FRAME[1],
        CROWD[0],
    );
    for record in results.records.iter().filter(|record| record.protocol == PROTOCOL) {
        write_row(record, &mut text);
    }
    text
}

/// Writes `results.json` into a folder, which is made where there is none.
///
/// # Errors
/// When the folder or the file cannot be written.
pub fn write(out: &Path, results: &Results) -> Result<(), PageError> {
    io(out, std::fs::create_dir_all(out))?;
    Ok(results.write(&out.join("results.json"))?)
}

fn write_row(record: &Record, text: &mut String) {
    let of = |name: &str| record.numbers.get(name).copied();
    let shown = |value: Option<f64>, digits: usize| value.map_or("-".into(), |v| format!("{v:.digits$}"));
    let number = |name: &str, digits: usize| shown(of(name), digits);
    let spread = |name: &str, digits: usize| match of(&format!("slowest_{name}")) {
        None => "-".to_owned(),
        Some(slowest) => format!("{} ({slowest:.digits$})", number(name, digits)),
    };
    let _ = writeln!(
        text,
        "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
        record.scene,
        number("scene_splats", 0),
        number("photos", 0),
        number("first_photo_s", 2),
        number("first_frame_s", 2),
        spread("hover_ms", 0),
        spread("crowd_hover_ms", 0),
        spread("first_answer_s", 2),
        spread("last_answer_s", 1),
        spread("sure_s", 1),
        number("frames_per_s", 1),
        number("server_mib", 0),
        shown(of("server_mib").zip(of("run_mib")).map(|(server, run)| server / run), 2),
    );
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

fn refused(path: &str, reason: impl Into<String>) -> StudioBenchError {
    StudioBenchError::Answer { path: path.to_owned(), reason: reason.into() }
}

/// Seconds from a click to its answers.
struct ClickTimes {
    /// To the first.
    first_s: f64,
    /// To the last.
    last_s: f64,
    /// Until it is known how sure the last is.
    sure_s: f64,
}

/// A client of the server.
struct StudioClient<'a> {
    target: &'a StudioTarget,
    base: String,
}

impl StudioClient<'_> {
    /// Sends a request; the answer's code and body.
    fn request(&self, method: &str, path: &str, body: &[u8]) -> Result<(u16, Vec<u8>), StudioBenchError> {
        let StudioTarget { address, token, .. } = self.target;
        let mut stream = TcpStream::connect(address)?;
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\nAuthorization: Bearer {token}\r\nContent-Length: {}\r\n\r\n",
            body.len()
        );
        stream.write_all(&[head.as_bytes(), body].concat())?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        let end = answer.windows(4).position(|four| four == b"\r\n\r\n");
        let code = answer.get(9..12).and_then(|code| std::str::from_utf8(code).ok()?.parse().ok());
        match (end, code) {
            (Some(end), Some(code)) => Ok((code, answer[end + 4..].to_vec())),
            _ => Err(refused(path, "no answer")),
        }
    }

    fn answered(&self, method: &str, path: &str, body: &[u8]) -> Result<Vec<u8>, StudioBenchError> {
        match self.request(method, &format!("{}/{path}", self.base), body)? {
            (200, body) => Ok(body),
            (code, body) => Err(refused(path, format!("{code}: {}", String::from_utf8_lossy(&body)))),
        }
    }

    fn get(&self, path: &str) -> Result<Vec<u8>, StudioBenchError> {
        self.answered("GET", path, b"")
    }

    fn get_json(&self, path: &str) -> Result<Value, StudioBenchError> {
        json_of(path, &self.get(path)?)
    }

    fn post(&self, path: &str, body: &Value) -> Result<Vec<u8>, StudioBenchError> {
        self.answered("POST", path, body.to_string().as_bytes())
    }

    /// The run, as soon as its session is open.
    fn description(&self) -> Result<Value, StudioBenchError> {
        let began = Instant::now();
        while began.elapsed() < LONGEST {
            let (code, body) = self.request("GET", &self.base, b"")?;
            match code {
                200 => return json_of(&self.base, &body),
                202 => std::thread::park_timeout(Duration::from_millis(5)),
                _ => return Err(refused(&self.base, String::from_utf8_lossy(&body))),
            }
        }
        Err(StudioBenchError::Late("the session"))
    }

    /// A pixel deep inside of a listed part in the photo that shows it best: the middle of its longest run of pixels.
    fn pixel_of(&self, part: &Value, photo: &Value) -> Result<Option<[f64; 2]>, StudioBenchError> {
        self.post("act", &json!({ "do": "listed", "number": part["number"] }))?;
        self.wait()?;
        let map = self.get_json(&format!("photos/{}/labels", part["photo"]))?;
        self.post("act", &json!({ "do": "prompt", "prompts": [] }))?;
        let side = |key: &str| map[key].as_u64().unwrap_or(1);
        let (mut at, mut best) = (0, (0, 0));
        let runs: Vec<u64> = map["runs"].as_array().into_iter().flatten().filter_map(Value::as_u64).collect();
        for run in runs.chunks_exact(2) {
            if run[0] == u64::from(self.target.answer_label) && run[1] > best.0 {
                best = (run[1], at + run[1] / 2);
            }
            at += run[1];
        }
        let full = |key: &str| photo["camera"][key].as_f64().unwrap_or(1.0);
        let (column, row) = (best.1 % side("width"), best.1 / side("width"));
        let share = |at: u64, key: &str| (at as f64 + 0.5) / side(key) as f64 * full(key);
        Ok((best.0 > 0).then(|| [share(column, "width"), share(row, "height")]))
    }

    /// Waits until the present answer is done.
    fn wait(&self) -> Result<ClickTimes, StudioBenchError> {
        let (began, mut first, mut last) = (Instant::now(), None, None);
        while began.elapsed() < LONGEST {
            let state = self.get_json("state")?;
            let answer = &state["answer"];
            if answer["splats"].as_u64().unwrap_or(0) > 0 {
                first.get_or_insert(began.elapsed().as_secs_f64());
            }
            let now = began.elapsed().as_secs_f64();
            if answer["step"] == "selected" {
                last.get_or_insert(now);
            }
            if answer["state"] != "working" {
                let [first_s, last_s] = [first, last].map(|at| at.unwrap_or(now));
                return Ok(ClickTimes { first_s, last_s, sure_s: now });
            }
            std::thread::park_timeout(Duration::from_millis(2));
        }
        Err(StudioBenchError::Late("the answer"))
    }

    /// Clicks, and waits for the answers.
    fn click(&self, prompt: &Value) -> Result<ClickTimes, StudioBenchError> {
        self.post("act", &json!({ "do": "prompt", "prompts": [prompt] }))?;
        let times = self.wait()?;
        self.post("act", &json!({ "do": "prompt", "prompts": [] }))?;
        Ok(times)
    }
}

fn json_of(path: &str, bytes: &[u8]) -> Result<Value, StudioBenchError> {
    serde_json::from_slice(bytes).map_err(|e| refused(path, e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_eval::compare::{Change, CompareOptions, compare};
    use std::net::TcpListener;

    #[test]
    fn a_refusal_of_the_server_is_named_with_its_request() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let target = StudioTarget {
            address: listener.local_addr().unwrap(),
            token: "secret".into(),
            run: "trevi".into(),
            answer_label: 255,
            started: Instant::now(),
        };
        let server = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut request = [0; 1024];
            let length = stream.read(&mut request).unwrap();
            stream.write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 11\r\n\r\nno such run").unwrap();
            String::from_utf8_lossy(&request[..length]).into_owned()
        });
        let error = studio(&target).unwrap_err().to_string();
        assert_eq!(error, "/api/v1/runs/trevi: no such run");
        let request = server.join().unwrap();
        assert!(request.starts_with("GET /api/v1/runs/trevi HTTP/1.1\r\n"), "{request}");
        assert!(request.contains("Authorization: Bearer secret\r\n"), "{request}");
    }

    #[test]
    fn a_camera_keeps_its_view_in_the_middle_of_a_frame() {
        let camera =
            json!({ "width": 320, "height": 480, "fx": 300.0, "fy": 300.0, "cx": 160.0, "cy": 240.0 });
        let frame = scaled(&camera);
        let number = |key: &str| frame[key].as_f64().unwrap();
        assert_eq!(["width", "height", "fx", "cx"].map(number), [640.0, 480.0, 300.0, 320.0]);
    }

    #[test]
    fn a_run_without_figures_has_dashes() {
        let figures = StudioFigures {
            provider: "built-in".into(),
            splats: 7,
            photos: 3,
            first_photo_s: 0.5,
            first_frame_s: 1.0,
            hover_ms: vec![3.0, 1.0, 2.0],
            crowd_ms: Vec::new(),
            first_answer_s: Vec::new(),
            last_answer_s: Vec::new(),
            sure_s: Vec::new(),
            frames_per_s: 24.0,
        };
        let row = StudioRow { run: "trevi".into(), figures, memory: [Some(3 << 20), Some(6 << 20)] };
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("studio");
        write(&out, &Results { records: vec![row.record()], ..Results::default() }).unwrap();
        let text = page(&Results::read(&out.join("results.json")).unwrap());
        assert!(text.starts_with("# What a person waits for on the page (built-in)\n"), "{text}");
        let row = "| trevi | 7 | 3 | 0.50 | 1.00 | 2 (3) | - | - | - | - | 24.0 | 3 | 0.50 |\n";
        assert!(text.ends_with(row), "{text}");
    }

    /// A run's row; times and memory grow with `cost`, the rate of frames falls with it.
    fn row(splats: usize, cost: f64) -> StudioRow {
        let times = |each: f64| vec![each * cost; 3];
        let figures = StudioFigures {
            provider: "built-in".into(),
            splats,
            photos: 4,
            first_photo_s: 0.5 * cost,
            first_frame_s: cost,
            hover_ms: times(4.0),
            crowd_ms: times(40.0),
            first_answer_s: times(0.5),
            last_answer_s: times(2.0),
            sure_s: times(3.0),
            frames_per_s: 20.0 / cost,
        };
        let bytes = Some((cost * f64::from(64 << 20)) as u64);
        StudioRow { run: "gate".into(), figures, memory: [bytes, bytes] }
    }

    #[test]
    fn every_time_and_every_mib_of_a_row_is_compared_and_the_size_of_its_scene_is_not() {
        let results = |row: StudioRow| {
            let mut results = Results::default();
            results.put(row.record());
            results
        };
        let old = results(row(1000, 1.0));
        let changes = |new: StudioRow| {
            let lines = compare(&old, &results(new), CompareOptions::default()).expect("the same provider");
            lines.into_iter().map(|line| (line.number, line.change)).collect::<BTreeMap<_, _>>()
        };
        let compared: Vec<String> = changes(row(1000, 1.0)).into_keys().collect();
        let described = ["photos", "scene_splats"];
        let measured = old.records[0].numbers.keys().filter(|name| !described.contains(&name.as_str()));
        assert_eq!(compared, measured.cloned().collect::<Vec<_>>());
        for (new, change) in [
            (row(2000, 1.0), Change::Same),
            (row(1000, 1.02), Change::Same),
            (row(1000, 3.0), Change::Worse),
            (row(1000, 0.3), Change::Better),
        ] {
            let changed = changes(new);
            // Of one pair a difference must be twice the margin: no fall of the slowest is, whose margin is a half.
            let mut decided = changed.iter().filter(|(name, _)| !name.starts_with("slowest_"));
            assert!(decided.all(|(_, found)| *found == change), "{change:?}: {changed:?}");
        }
        let slow = changes(row(1000, 3.0));
        assert!(slow.values().all(|change| *change == Change::Worse), "{slow:?}");
    }
}
