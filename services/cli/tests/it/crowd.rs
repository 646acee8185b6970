//! Crowds at `--metrics-listen`, and processes that may open few files: work goes on, or says what it lacks and loses nothing.
#![cfg(unix)]

use crate::common::*;
use segwild_flow::shortage::raise_open_files;
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};

/// Files that the process may have open, and connections of the crowd: more than that.
const FILES: u32 = 256;
const CROWD: usize = 400;
/// Steps of a training that is not over before the crowd is there.
const STEPS: &str = "1500";

/// The program in a shell that may open so few files.
fn with_few_files(limit: u32, args: &[String]) -> Command {
    let mut command = Command::new("sh");
    command.args(["-c", &format!("ulimit -n {limit} && exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_segwild")]);
    command.args(args);
    command
}

/// Starts it, and gathers a crowd that connects and says nothing until it has ended; what it printed, if this machine lets a
/// test open so many connections.
fn amid_a_crowd(name: &str, args: &[String]) -> Option<(Child, String)> {
    if raise_open_files().is_some_and(|limit| (limit as usize) < CROWD + 100) {
        println!("skipped: {name}: this process may not open {CROWD} connections");
        return None;
    }
    let mut command = with_few_files(FILES, args);
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("a shell");
    let mut lines = BufReader::new(child.stderr.take().expect("a pipe")).lines().map_while(Result::ok);
    let first = lines.next().expect("it speaks");
    let address = first.strip_prefix("listening on http://").unwrap_or_else(|| panic!("{first}"));
    let crowd: Vec<_> = (0..CROWD).map(|_| TcpStream::connect(address)).collect();
    assert!(child.try_wait().expect("a child").is_none(), "it was over before the crowd came");
    let stdout = lines.collect::<Vec<_>>().join("\n");
    assert!(crowd.iter().all(Result::is_ok), "it stopped accepting");
    Some((child, stdout))
}

fn listening(args: &[String]) -> Vec<String> {
    [args, &["--metrics-listen".to_owned(), "127.0.0.1:0".to_owned()]].concat()
}

#[test]
fn a_crowd_of_idle_connections_does_not_end_a_run() {
    let dir = folder();
    let run = dir.path().join("run");
    let name = "a_crowd_of_idle_connections_does_not_end_a_run";
    let long = ["--steps", STEPS];
    let Some((mut child, stdout)) = amid_a_crowd(name, &listening(&again(&run, &long))) else { return };
    assert_eq!(child.wait().expect("it ends").code(), Some(0), "{stdout}");
    let untouched = dir.path().join("untouched");
    completes(&again(&untouched, &long));
    same_results(&run, &untouched);
}

fn manifest(dir: &Path) -> String {
    let file = dir.join("scenes.toml");
    let settings =
        format!("settings = {{ size = 96, steps = {STEPS}, refine_steps = 4, prompt_budget = 24 }}");
    let scene = scene().display();
    let text =
        format!("[defaults]\nattempts = 1\n{settings}\n[[scene]]\nname = \"one\"\npath = \"{scene}\"\n");
    std::fs::write(&file, text).expect("it writes");
    show(&file)
}

#[test]
fn a_crowd_of_idle_connections_costs_a_batch_no_attempt() {
    let dir = folder();
    let batch = show(&dir.path().join("batch"));
    let args = ["batch".to_owned(), manifest(dir.path()), "--out".to_owned(), batch.clone()];
    let name = "a_crowd_of_idle_connections_costs_a_batch_no_attempt";
    let Some((mut child, stdout)) = amid_a_crowd(name, &listening(&args)) else { return };
    assert_eq!(child.wait().expect("it ends").code(), Some(0), "{stdout}");
    let view = json(&segwild(&["status", &batch, "--json"]).stdout);
    assert_eq!((&view["scenes"][0]["state"], &view["scenes"][0]["failures"]), (&"done".into(), &0.into()));
}

#[test]
fn a_process_that_may_open_too_few_files_says_so_before_it_starts() {
    let dir = folder();
    let out = dir.path().join("out");
    let batch = ["batch".to_owned(), manifest(dir.path()), "--out".to_owned(), show(&out)];
    for args in [again(&out, &[]), batch.to_vec()] {
        let output = with_few_files(40, &args).output().expect("a shell");
        let stdout = text(&output.stderr);
        assert_eq!(output.status.code(), Some(8), "{stdout}");
        assert!(stdout.contains("only 40 files open") && stdout.contains("ulimit -n"), "{stdout}");
        assert!(!out.exists(), "nothing has begun");
    }
}

#[test]
fn the_least_number_of_files_is_enough() {
    let dir = folder();
    let run = dir.path().join("run");
    let args = listening(&again(&run, &[]));
    let least = u32::try_from(segwild_flow::shortage::FILES_NEEDED).expect("a small number");
    let output = with_few_files(least, &args).output().expect("a shell");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    same_as_untouched(&run);
}
