//! Killed at any moment, a run ends in the same bytes.

use super::row::{FlowError, FlowOptions, Row, io};
use super::scene::{fresh, write_scene};
use segwild_flow::Ledger;
use segwild_flow::ledger::State;
use segwild_synthetic::Manifest;
use std::collections::BTreeMap;
use std::hash::{BuildHasher, RandomState};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// What is compared, beside every artefact in the cache and everything of the selection.
const FILES: [&str; 5] = ["model.bin", "features.bin", "scene.ply", "history.jsonl", "evaluation.json"];

/// What a selection took; never the same twice.
const TIMES: &str = "summary.json";

struct Program<'a> {
    path: &'a Path,
    scene: PathBuf,
    photo: String,
    click: String,
}

/// Where kills are aimed at, by stage: the point, and about how often a run passes it before and in the stage.
const AIMS: [(&str, &str, [usize; 2]); 10] = [
    ("sky", "masks.handle", [1, 14]),
    ("embed", "features.handle", [1, 12]),
    ("geometry", "trainer.step", [1, 300]),
    ("masks", "masks.handle", [15, 26]),
    ("visibility", "visibility.photo", [1, 12]),
    ("features", "features.step", [1, 52]),
    ("evaluate", "evaluate.photo", [1, 2]),
    ("report", "report.image", [1, 8]),
    ("selection", "segmenter.handle", [1, 1]),
    ("selection, half written", "selection.file", [1, 16]),
];

impl Program<'_> {
    /// The two commands of a session: the run, and a click.
    fn commands(&self, run: &Path) -> [Command; 2] {
        let mut train = Command::new(self.path);
        train.arg("run").arg(&self.scene).arg("--out").arg(run).args([
            "--preset",
            "draft",
            "--size",
            "128",
            "--steps",
            "300",
            "--refine-steps",
            "40",
            "--prompt-budget",
            "32",
            "--checkpoint-every",
            "1",
        ]);
        let mut click = Command::new(self.path);
        click.arg("segment").arg(run).args([
            "--photo",
            &self.photo,
            "--positive",
            &self.click,
            "--name",
            "it",
        ]);
        [train, click].map(|mut command| {
            command.stdout(Stdio::null()).stderr(Stdio::null());
            command
        })
    }

    /// Runs both to the end.
    fn complete(&self, run: &Path) -> Result<f64, FlowError> {
        let began = Instant::now();
        for mut command in self.commands(run) {
            let status = io("start segwild", command.status())?;
            if !status.success() {
                return Err(FlowError::Child(format!("{command:?} ended with {status}")));
            }
        }
        Ok(began.elapsed().as_secs_f64())
    }

    /// Runs both with a fault that kills them at a point; whether one was killed.
    fn killed_at(&self, run: &Path, fault: &str) -> Result<bool, FlowError> {
        for mut command in self.commands(run) {
            let status = io("start segwild", command.args(["--fault", fault]).status())?;
            if status.code().is_none() {
                return Ok(true);
            }
            if !status.success() {
                return Err(FlowError::Child(format!("{command:?} ended with {status}")));
            }
        }
        Ok(false)
    }

    /// Runs both, and kills whichever runs when the time has come.
    fn killed_after(&self, run: &Path, time: Duration) -> Result<bool, FlowError> {
        let end = Instant::now() + time;
        for mut command in self.commands(run) {
            let mut child = io("start segwild", command.spawn())?;
            loop {
                if io("wait for segwild", child.try_wait())?.is_some() {
                    break;
                }
                let left = end.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    io("kill segwild", child.kill())?;
                    io("wait for segwild", child.wait())?;
                    return Ok(true);
                }
                std::thread::park_timeout(left.min(Duration::from_millis(2)));
            }
        }
        Ok(false)
    }
}

/// The hash of everything that must not depend on an interruption.
fn results(run: &Path) -> Result<BTreeMap<PathBuf, blake3::Hash>, FlowError> {
    let mut files: Vec<PathBuf> = FILES.iter().map(|f| run.join(f)).filter(|f| f.is_file()).collect();
    let mut folders = vec![run.join("cache"), run.join("selections")];
    while let Some(folder) = folders.pop() {
        for entry in io(format!("read {}", folder.display()), std::fs::read_dir(&folder))?.flatten() {
            let path = entry.path();
            let aside = ["tmp", "corrupt"].iter().any(|n| entry.file_name() == *n);
            if path.is_dir() && !aside {
                folders.push(path);
            } else if path.is_file()
                && entry.file_name() != TIMES
                && !entry.file_name().to_string_lossy().starts_with('.')
            {
                files.push(path);
            }
        }
    }
    let mut hashes = BTreeMap::new();
    for file in files {
        let bytes = io(format!("read {}", file.display()), std::fs::read(&file))?;
        hashes.insert(file.strip_prefix(run).unwrap_or(&file).to_owned(), blake3::hash(&bytes));
    }
    Ok(hashes)
}

/// Which stages were under way.
fn under_way(run: &Path) -> Vec<String> {
    let Ok(ledger) = Ledger::open_read_only(run.join("run.sqlite")) else { return vec!["start".into()] };
    let stages = ledger.stages().unwrap_or_default();
    let running: Vec<String> =
        stages.iter().filter(|s| s.state == State::Running).map(|s| s.name.clone()).collect();
    let all_done = stages.iter().any(|s| s.name == "report" && s.state == State::Done);
    match (running.is_empty(), all_done) {
        (false, _) => running,
        (true, true) => vec!["selection".into()],
        (true, false) => vec!["start".into()],
    }
}

fn click(manifest: &Manifest) -> Option<(String, String)> {
    let objects = manifest.objects.iter().filter(|o| o.name != "ground");
    let best = objects.flat_map(|o| &o.clicks).max_by_key(|c| c.visible)?;
    Some((best.photo.clone(), format!("{},{}", best.x, best.y)))
}

/// A moment in the `k`th of `n` slices of a run, as a share of it; random, other than the time before, and no later
/// than `longest`.
fn moment(k: usize, n: usize, longest: f64) -> f64 {
    // The standard library seeds every state from the system's random source.
    let draw = RandomState::new().hash_one(k) as f64 / u64::MAX as f64;
    longest * (k as f64 + draw) / n as f64
}

/// A pass of a point in the `k`th of `n` slices of those that it has in a stage; random.
fn pass(k: usize, n: usize, [first, last]: [usize; 2]) -> usize {
    let draw = RandomState::new().hash_one(k) as f64 / u64::MAX as f64;
    let count = (last - first + 1) as f64;
    (first + (count * (k as f64 + draw) / n as f64) as usize).min(last)
}

/// Kills runs at moments spread over their whole length, lets each go on, and counts those that end differently.
pub fn kills(options: &FlowOptions) -> Result<Vec<Row>, FlowError> {
    let dir = fresh(&options.dir.join("kills"))?;
    let scene = dir.join("scene");
    let manifest = write_scene(&scene, 12, 128)?;
    let (photo, click) =
        click(&manifest).ok_or_else(|| FlowError::Child("the scene shows no object".into()))?;
    let program = Program { path: &options.program, scene, photo, click };
    let untouched = dir.join("untouched");
    program.complete(&untouched)?;
    // Once more, with a warm disk: this is how long a run takes.
    let whole = program.complete(&fresh(&dir.join("timed"))?)?;
    let expected = results(&untouched)?;
    let mut different = Vec::new();
    let mut finish = |run: &Path| -> Result<(), FlowError> {
        program.complete(run)?;
        let got = results(run)?;
        if got != expected {
            let odd = expected.iter().find(|(file, hash)| got.get(*file) != Some(hash));
            different.push(odd.map_or("an extra file".into(), |(file, _)| file.display().to_string()));
        }
        Ok(())
    };
    let mut stages: BTreeMap<String, usize> = BTreeMap::new();
    for k in 0..options.kills {
        // One that ended before its moment came says nothing: another moment is sampled, and not as late.
        let mut run = fresh(&dir.join("run"))?;
        let mut longest = 1.0;
        while !program
            .killed_after(&run, Duration::from_secs_f64(whole * moment(k, options.kills, longest)))?
        {
            run = fresh(&run)?;
            longest *= 0.9;
        }
        for stage in under_way(&run) {
            *stages.entry(stage).or_default() += 1;
        }
        finish(&run)?;
    }
    let mut aimed = Vec::new();
    for (stage, point, passes) in AIMS {
        let each = options.kills.div_ceil(17);
        for k in 0..each {
            let run = fresh(&dir.join("run"))?;
            if !program.killed_at(&run, &format!("kill@{point}:{}", pass(k, each, passes)))? {
                return Err(FlowError::Child(format!("a run does not pass {point} as often as it should")));
            }
            finish(&run)?;
        }
        aimed.push(format!("{stage} {each}"));
    }
    let stages: Vec<String> = stages.iter().map(|(stage, n)| format!("{stage} {n}")).collect();
    let odd = different.first().map_or(String::new(), |file| format!("; first: {file}"));
    Ok(vec![Row {
        name: "kills".into(),
        what: "runs that end in other bytes after a SIGKILL: model, features, masks, selection".into(),
        value: different.len() as f64,
        bar: 0.0,
        from: format!(
            "{} runs of {whole:.1} s, each killed once at random in its slice of that time (while under way: {}), and \
             others killed at a random pass of a point in a stage ({}); {} files compared{odd}",
            options.kills,
            stages.join(", "),
            aimed.join(", "),
            expected.len()
        ),
        load: None,
    }])
}
