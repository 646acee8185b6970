//! What the program's tests share: a small synthetic place, a finished run on it, and the program itself.
#![allow(dead_code, reason = "each test file uses a part of it")]

use segwild_bench::synthetic::{LookKind, Manifest, SyntheticOptions, generate};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

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

pub struct Place {
    _dir: tempfile::TempDir,
    pub scene: PathBuf,
    pub run: PathBuf,
    pub manifest: Manifest,
}

pub const QUICK: [&str; 8] =
    ["--size", "96", "--steps", "60", "--refine-steps", "4", "--prompt-budget", "24"];

/// A small place and a finished run on it, made once.
pub fn place() -> &'static Place {
    static PLACE: OnceLock<Place> = OnceLock::new();
    PLACE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let (scene, run) = (dir.path().join("place"), dir.path().join("run"));
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
        let (s, r) = (scene.display().to_string(), run.display().to_string());
        works(&[&["run", &s, "--out", &r][..], &QUICK].concat());
        Place { _dir: dir, scene, run, manifest }
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
