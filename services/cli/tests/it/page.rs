//! `segwild serve`: its command line, and the page in a real browser.

use crate::common::*;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// The tests of the page, in JavaScript.
fn browser_tests() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../studio/tests/browser")
}

/// Whether a program answers to `--version`.
fn is_there(program: &str) -> bool {
    Command::new(program).arg("--version").output().is_ok_and(|output| output.status.success())
}

#[test]
fn the_page_does_what_a_person_wants_in_a_real_browser() {
    let tests = browser_tests();
    let missing = [
        (!is_there("node"), "Node.js is not installed"),
        (!tests.join("node_modules").is_dir(), "`npm ci` has not been run in services/studio/tests/browser"),
        (!is_there("chromium"), "Chromium is not installed"),
    ];
    if let Some((_, why)) = missing.iter().find(|(missing, _)| *missing) {
        println!("skipped: the_page_does_what_a_person_wants_in_a_real_browser: {why}");
        return;
    }
    let dir = folder();
    let output = Command::new("node")
        .args(["--test", "--test-concurrency=1", "."])
        .current_dir(&tests)
        .env("SEGWILD", env!("CARGO_BIN_EXE_segwild"))
        .env("SEGWILD_RUN", copied_run(&dir))
        .output()
        .expect("node starts");
    assert!(output.status.success(), "{}\n{}", text(&output.stdout), text(&output.stderr));
}

/// A server that is being started, and the first line that it prints.
fn served(args: &[&str]) -> (Child, String) {
    let mut child = Command::new(env!("CARGO_BIN_EXE_segwild"))
        .arg("serve")
        .args(args)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("it starts");
    let mut line = String::new();
    BufReader::new(child.stdout.take().expect("a pipe")).read_line(&mut line).expect("it prints its address");
    (child, line)
}

#[test]
fn the_address_is_printed_with_its_token_and_an_end_by_ctrl_c_is_no_failure() {
    let dir = folder();
    let run = show(&copied_run(&dir));
    let (mut child, line) = served(&[&run, "--listen", "127.0.0.1:0"]);
    assert!(line.contains("http://127.0.0.1:") && line.contains("/?token="), "{line}");
    signal(&child, "-INT");
    assert_eq!(child.wait().expect("it ends").code(), Some(0));
}

#[test]
fn other_machines_are_let_in_only_with_a_token_file_or_a_flag_that_says_so() {
    let dir = folder();
    let run = show(&copied_run(&dir));
    refuses(&["serve", &run, "--listen", "0.0.0.0:0"], 2, &["--token-file", "--insecure"]);
    refuses(&["serve", "no-such-folder"], 6, &["there is no such folder"]);
    let file = dir.path().join("token");
    let (mut child, line) = served(&[&run, "--listen", "0.0.0.0:0", "--token-file", &show(&file)]);
    let token = std::fs::read_to_string(&file).expect("the token was made");
    assert!(line.contains(token.trim()), "{line}");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let mode = std::fs::metadata(&file).expect("a file").permissions().mode();
        assert_eq!(mode & 0o077, 0, "only its owner may read it: {mode:o}");
    }
    child.kill().expect("it runs");
    child.wait().expect("it ends");
    // The same token again; a short one is refused.
    let (mut child, line) = served(&[&run, "--listen", "127.0.0.1:0", "--token-file", &show(&file)]);
    assert!(line.contains(token.trim()), "{line}");
    child.kill().expect("it runs");
    child.wait().expect("it ends");
    std::fs::write(&file, "short").expect("it can be written");
    refuses(&["serve", &run, "--token-file", &show(&file)], 2, &["16 letters"]);
}
