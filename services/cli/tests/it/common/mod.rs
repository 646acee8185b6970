//! What the program's tests share: a small synthetic scene, a finished run on it, and the program itself.

#[path = "../../../../../tests/support/made_once.rs"]
pub mod made_once;

pub use made_once::made_once;
use segwild_synthetic::{Click, LightVariation, Manifest, SyntheticOptions, generate};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::{OnceLock, mpsc};
use std::time::Duration;

pub fn segwild(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_segwild")).args(args).output().expect("the program starts")
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs it, expects an exit code and words on standard error.
pub fn refuses(args: &[&str], code: i32, words: &[&str]) {
    let output = segwild(args);
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{args:?} printed: {error}");
    for word in words {
        assert!(error.contains(word), "{args:?} does not say `{word}`: {error}");
    }
    assert!(!error.contains("panicked"), "{error}");
}

pub fn works(args: &[&str]) -> String {
    let output = segwild(args);
    assert_eq!(output.status.code(), Some(0), "{args:?} printed: {}", text(&output.stderr));
    text(&output.stdout)
}

pub fn json(bytes: &[u8]) -> serde_json::Value {
    serde_json::from_slice(bytes).unwrap_or_else(|e| panic!("{e}: {}", text(bytes)))
}

/// A child that does not outlive its test.
pub struct Guarded(pub Child);

impl Drop for Guarded {
    fn drop(&mut self) {
        // One that has ended by itself is as good.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts it without listening to what it says.
pub fn in_background(args: &[&str]) -> Guarded {
    let child = Command::new(env!("CARGO_BIN_EXE_segwild"))
        .args(args)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts");
    Guarded(child)
}

#[cfg(unix)]
pub fn signal(child: &Child, signal: &str) {
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status();
    assert!(sent.expect("`kill` is there").success());
}

pub fn rest(time: Duration) {
    // A channel that nobody sends to: a wait that clippy's sleeping actors are not meant by.
    let (_never, next) = mpsc::channel::<()>();
    let _ = next.recv_timeout(time);
}

/// Looks again and again until there is something to see.
pub fn until<T>(what: &str, mut see: impl FnMut() -> Option<T>) -> T {
    for _ in 0..3000 {
        if let Some(seen) = see() {
            return seen;
        }
        rest(Duration::from_millis(40));
    }
    panic!("{what} did not come");
}

pub struct SharedRun {
    pub scene: PathBuf,
    pub run: PathBuf,
    pub manifest: Manifest,
}

/// Few steps leave new splats no time to become opaque: no more of them than the photos need.
/// And no time goes to the choice of an appearance model.
pub const QUICK: [&str; 12] = [
    "--size",
    "96",
    "--steps",
    "60",
    "--splats",
    "2000",
    "--refine-steps",
    "4",
    "--prompt-budget",
    "24",
    "--appearance-model",
    "affine",
];

/// A small scene, made once, for who runs it in another way than [`shared_run`].
pub fn scene() -> &'static Path {
    static SCENE: OnceLock<PathBuf> = OnceLock::new();
    SCENE.get_or_init(|| {
        let made = made_once("scene", &[], |folder| {
            let options = SyntheticOptions {
                train: 8,
                test: 2,
                long_side: 96,
                points: 600,
                occlusion: 0.0,
                photo_light: LightVariation::Affine,
                ..SyntheticOptions::small()
            };
            generate(&options).and_then(|s| s.write(&folder.join("scene"))).expect("a synthetic scene");
        });
        made.join("scene")
    })
}

/// The small scene and a finished run on it, made once.
pub fn shared_run() -> &'static SharedRun {
    static SHARED_RUN: OnceLock<SharedRun> = OnceLock::new();
    SHARED_RUN.get_or_init(|| {
        let scene = scene().to_owned();
        let made = made_once("run", &[Path::new(env!("CARGO_BIN_EXE_segwild"))], |folder| {
            works(&[&["run", &show(&scene), "--out", &show(&folder.join("run"))][..], &QUICK].concat());
        });
        let manifest = std::fs::read(scene.join("truth.json")).expect("the scene has a manifest");
        let manifest = serde_json::from_slice(&manifest).expect("it is JSON");
        SharedRun { scene, run: made.join("run"), manifest }
    })
}

/// The same run in a folder of the caller's own, to change or break.
pub fn copied_run(dir: &tempfile::TempDir) -> PathBuf {
    let run = dir.path().join("run");
    copy_folder(&shared_run().run, &run);
    run
}

pub fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

pub fn show(path: &Path) -> String {
    path.display().to_string()
}

pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a folder");
    for entry in std::fs::read_dir(from).expect("a folder").flatten() {
        let (path, name) = (entry.path(), entry.file_name());
        if path.is_dir() {
            copy_folder(&path, &to.join(name));
        } else {
            std::fs::copy(&path, to.join(name)).expect("it is copied");
        }
    }
}

/// The command line of the finished run, into another folder.
pub fn again(out: &Path, more: &[&str]) -> Vec<String> {
    let (scene, out) = (show(&shared_run().scene), show(out));
    let mut args = vec!["run".to_owned(), scene, "--out".into(), out];
    for flag in QUICK.chunks(2).filter(|flag| !more.contains(&flag[0])) {
        args.extend(flag.iter().map(|s| (*s).to_owned()));
    }
    args.extend(more.iter().map(|s| (*s).to_owned()));
    args
}

pub fn output(args: &[String]) -> Output {
    segwild(&args.iter().map(String::as_str).collect::<Vec<_>>())
}

pub fn completes(args: &[String]) -> (String, String) {
    let output = output(args);
    let (out, error) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(0), "{args:?} printed: {error}");
    (out, error)
}

pub fn start(args: &[String]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_segwild"))
        .args(args)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts")
}

/// The hash of everything a run made: model, features, scores, and every artefact in the cache.
pub fn results(run: &Path) -> BTreeMap<PathBuf, blake3::Hash> {
    let mut found = BTreeMap::new();
    let mut folders = vec![run.join("cache"), run.join("selections")];
    let mut files: Vec<PathBuf> =
        ["model.bin", "features.bin", "scene.ply", "evaluation.json", "history.jsonl"]
            .map(|f| run.join(f))
            .into();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let name = entry.file_name();
            if entry.path().is_dir() && name != "tmp" && name != "corrupt" {
                folders.push(entry.path());
            // The summary of a selection says how long it took.
            } else if entry.path().is_file()
                && name != "summary.json"
                && !name.to_string_lossy().starts_with('.')
            {
                files.push(entry.path());
            }
        }
    }
    for file in files {
        let bytes = std::fs::read(&file).expect("it is there");
        found.insert(file.strip_prefix(run).expect("inside").to_owned(), blake3::hash(&bytes));
    }
    found
}

/// Compares with the run that nothing happened to.
pub fn same_as_untouched(run: &Path) {
    same_results(run, &shared_run().run);
}

/// Compares what a run made with what an untouched one made, by every byte.
pub fn same_results(run: &Path, untouched: &Path) {
    let (ours, theirs) = (results(run), results(untouched));
    for (file, hash) in &theirs {
        assert_eq!(ours.get(file), Some(hash), "{} differs or is missing", file.display());
    }
    assert_eq!(ours.len(), theirs.len(), "something was made that an untouched run does not make");
}

/// Waits until a condition holds while a child lives.
pub fn wait_for(child: &mut Child, what: &str, done: impl Fn() -> bool) {
    while !done() {
        assert!(child.try_wait().expect("a child").is_none(), "it ended before: {what}");
        std::thread::yield_now();
    }
}

/// As [`same_as_untouched`], where something else was made in the same folder as well.
pub fn has_what_an_untouched_run_has(run: &Path) {
    has_all_of(run, &results(&shared_run().run));
}

/// Asserts that a run has all these files, byte for byte.
pub fn has_all_of(run: &Path, expected: &BTreeMap<PathBuf, blake3::Hash>) {
    let ours = results(run);
    for (file, hash) in expected {
        assert_eq!(ours.get(file), Some(hash), "{} differs or is missing", file.display());
    }
}

/// The object of the scene that some photo shows best, and a click into it there.
pub fn clearest() -> (&'static str, &'static Click) {
    let things = shared_run().manifest.objects.iter().filter(|o| o.name != "ground");
    let clicks = things.flat_map(|o| o.clicks.iter().map(move |c| (o.name.as_str(), c)));
    clicks.max_by_key(|(_, c)| c.visible).expect("an object that shows")
}

/// Clicks into an object of the scene, in a run of it.
pub fn select(run: &Path, fault: &[&str]) -> Output {
    let click = &shared_run().manifest.objects.iter().flat_map(|o| &o.clicks).next().expect("a click");
    let (run, at) = (show(run), format!("{},{}", click.x, click.y));
    segwild(&[&["segment", &run, "--photo", &click.photo, "--positive", &at, "--name", "it"], fault].concat())
}

/// How many per-photo artefacts a run made, by what it says with `--json`.
pub fn made(stdout: &str) -> u64 {
    let summary: serde_json::Value =
        serde_json::from_str(stdout.lines().last().expect("a last line")).expect("JSON");
    summary["summary"]["made"].as_u64().expect("a number")
}

/// What `--json` prints: one object a line.
pub fn lines(stdout: &str) -> Vec<serde_json::Value> {
    let object = |line| {
        let value: serde_json::Value = serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}"));
        assert!(value.is_object(), "no object: {line}");
        value
    };
    stdout.lines().map(object).collect()
}
