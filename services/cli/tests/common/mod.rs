//! What the program's tests share: a small synthetic place, a finished run on it, and the program itself.
#![allow(dead_code, reason = "each test file uses a part of it")]

use segwild_bench::synthetic::{LookKind, Manifest, SyntheticOptions, generate};
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
    assert_eq!(output.status.code(), Some(code), "{args:?} said: {error}");
    for word in words {
        assert!(error.contains(word), "{args:?} does not say `{word}`: {error}");
    }
    assert!(!error.contains("panicked"), "{error}");
}

pub fn works(args: &[&str]) -> String {
    let output = segwild(args);
    assert_eq!(output.status.code(), Some(0), "{args:?} said: {}", text(&output.stderr));
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
pub fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    for _ in 0..3000 {
        if let Some(seen) = look() {
            return seen;
        }
        rest(Duration::from_millis(40));
    }
    panic!("{what} did not come");
}

pub struct Place {
    pub scene: PathBuf,
    pub run: PathBuf,
    pub manifest: Manifest,
}

pub const QUICK: [&str; 8] =
    ["--size", "96", "--steps", "60", "--refine-steps", "4", "--prompt-budget", "24"];

struct Photographed {
    dir: tempfile::TempDir,
    scene: PathBuf,
    manifest: Manifest,
}

fn photographed() -> &'static Photographed {
    static SCENE: OnceLock<Photographed> = OnceLock::new();
    SCENE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let scene = dir.path().join("place");
        let options = SyntheticOptions {
            train: 8,
            test: 2,
            long_side: 96,
            points: 600,
            occlusion: 0.0,
            look: LookKind::Affine,
            ..SyntheticOptions::small()
        };
        let manifest = generate(&options).and_then(|s| s.write(&scene)).expect("a synthetic place");
        Photographed { dir, scene, manifest }
    })
}

/// A small place, made once, for who runs it in another way than [`place`].
pub fn scene() -> &'static Path {
    &photographed().scene
}

/// The small place and a finished run on it, made once.
pub fn place() -> &'static Place {
    static PLACE: OnceLock<Place> = OnceLock::new();
    PLACE.get_or_init(|| {
        let Photographed { dir, scene, manifest } = photographed();
        let run = dir.path().join("run");
        works(&[&["run", &show(scene), "--out", &show(&run)][..], &QUICK].concat());
        Place { scene: scene.clone(), run, manifest: manifest.clone() }
    })
}

/// The same run in a folder of the caller's own, to change or break.
pub fn copied_run(dir: &tempfile::TempDir) -> PathBuf {
    let run = dir.path().join("run");
    copy_folder(&place().run, &run);
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
