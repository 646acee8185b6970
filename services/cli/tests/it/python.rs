//! The package for Python: its tests on a run of this program, and its notebook from photos to a labelled cloud, which the
//! tutorial's test runs.

use crate::common::*;
use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// A Python that has the packages of these names, where `pip` put those of a file; `None` with a line where one is missing.
pub fn python(test: &str, packages: &str, file: &str) -> Option<Command> {
    let found = root().join("target/tools/python");
    let start = || {
        let mut python = Command::new("python3");
        python.env("PYTHONPATH", &found).env("PYTHONDONTWRITEBYTECODE", "1");
        python
    };
    let can = start().args(["-c", &format!("import {packages}")]).output();
    if can.is_ok_and(|output| output.status.success()) {
        return Some(start());
    }
    eprintln!("skipped: {test}: python3 has no {packages} (pip install --no-deps -r {file})");
    None
}

/// Runs tests of the package, and expects that all of them ran and passed.
fn passes(mut python: Command, args: &[&str]) {
    let package = root().join("services/python");
    python
        .args(["-m", "unittest"])
        .args(args)
        .current_dir(package)
        .env("SEGWILD", env!("CARGO_BIN_EXE_segwild"));
    let output = python.output().expect("it starts");
    let printed = text(&output.stderr);
    assert!(output.status.success(), "{printed}");
    assert!(printed.contains("\nOK") && !printed.contains("skipped="), "{printed}");
}

#[test]
fn python_reads_from_a_run_what_the_program_and_other_readers_do() {
    let test = "python_reads_from_a_run_what_the_program_and_other_readers_do";
    let Some(mut python) = python(test, "numpy, plyfile, pycocotools", ".ci/python.txt") else { return };
    let dir = folder();
    python.env("SEGWILD_TEST_SCENE", &shared_run().scene).env("SEGWILD_TEST_RUN", copied_run(&dir));
    passes(python, &["discover", "--start-directory", "tests", "--top-level-directory", "."]);
}

/// Runs the notebook in a folder that has the run which the notebook trains: the program finds it done.
pub fn notebook_passes(folder: &Path) {
    let Some(mut python) = python("the notebook", "numpy", ".ci/python.txt") else { return };
    python.env("SEGWILD_TEST_NOTEBOOK", folder);
    passes(python, &["tests.notebook"]);
}
