//! Models on other machines: a run by a vision service ends in the bytes of a run by itself, whatever happens to the service.

use crate::common::*;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// A service in a process of its own, and its address.
fn serve(listen: &str, more: &[&str]) -> (Guarded, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_segwild"));
    command.args(["vision", "serve", "--listen", listen]).args(more);
    started(&mut command)
}

/// Starts it and waits until it prints where it serves.
fn started(command: &mut Command) -> (Guarded, String) {
    let mut child = Guarded(command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("it starts"));
    let printed = BufReader::new(child.0.stdout.take().expect("it is piped"));
    let address = printed.lines().map_while(Result::ok).find_map(|line| {
        let at = line.find("grpc://")?;
        Some(line[at..].to_owned())
    });
    (child, address.expect("it prints where it serves"))
}

fn listen(address: &str) -> &str {
    address.trim_start_matches("grpc://")
}

/// The artefacts that a service makes here have names of their own: the model of the scene, and what it selects, do not.
fn same_scene(run: &Path) {
    for file in ["model.bin", "features.bin", "scene.ply"] {
        let bytes = |run: &Path| std::fs::read(run.join(file)).expect("it is there");
        assert!(bytes(run) == bytes(&shared_run().run), "{file} differs");
    }
}

fn masks_of(run: &Path) -> usize {
    std::fs::read_dir(run.join("cache")).map_or(0, |entries| entries.count())
}

#[test]
fn a_run_by_a_service_is_a_run_by_itself_and_the_second_one_calls_nobody() {
    let dir = folder();
    let (service, address) = serve("127.0.0.1:0", &["--parallel", "2"]);
    let run = dir.path().join("run");
    let args = again(&run, &["--masks", &address, "--json"]);
    let (stdout, _) = completes(&args);
    assert!(stdout.contains("built-in by the vision service grpc://127.0.0.1"), "{stdout}");
    assert!(made(&stdout) > 0);
    same_scene(&run);
    let (stdout, _) = completes(&args);
    assert_eq!(made(&stdout), 0, "{stdout}");

    // A run folder names no machine that photos are sent to.
    let refused = select(&run, &[]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("--vision-service grpc://HOST:PORT"), "{}", text(&refused.stderr));
    let by_service = select(&run, &["--vision-service", &address]);
    assert_eq!(by_service.status.code(), Some(0), "{}", text(&by_service.stderr));
    let own = dir.path().join("own");
    copy_folder(&shared_run().run, &own);
    assert_eq!(select(&own, &[]).status.code(), Some(0));
    let object = |run: &Path| std::fs::read(run.join("selections/it/object.ply")).expect("an object");
    assert!(object(&run) == object(&own), "the same click gives the same object");
    drop(service);
}

#[test]
fn a_service_that_is_killed_and_comes_back_costs_nothing_but_time() {
    let dir = folder();
    let ((mut first, one), (second, other)) = (serve("127.0.0.1:0", &[]), serve("127.0.0.1:0", &[]));
    let run = dir.path().join("run");
    let both = format!("{one},{other}");
    let mut child = start(&again(&run, &["--masks", &both]));
    wait_for(&mut child, "an artefact", || masks_of(&run) > 2);
    first.0.kill().expect("it is killed");
    first.0.wait().expect("it ends");
    drop(second);
    let (_service, again_there) = serve(listen(&one), &[]);
    assert_eq!(again_there, one);
    let output = child.wait_with_output().expect("it ends");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    same_scene(&run);
}

#[test]
fn a_run_whose_service_is_gone_stops_in_words_and_the_same_command_continues() {
    let dir = folder();
    let (mut service, address) = serve("127.0.0.1:0", &[]);
    let run = dir.path().join("run");
    let args = again(&run, &["--masks", &address, "--vision-patience", "1"]);
    let mut child = start(&args);
    wait_for(&mut child, "an artefact", || masks_of(&run) > 2);
    service.0.kill().expect("it is killed");
    service.0.wait().expect("it ends");
    let output = child.wait_with_output().expect("it ends");
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{error}");
    assert!(error.contains("no vision service has answered for 1 s") && error.contains(&address), "{error}");
    let (_service, _) = serve(listen(&address), &[]);
    completes(&args);
    same_scene(&run);
}

#[test]
fn a_service_lets_other_machines_in_with_a_token_only() {
    refuses(&["vision", "serve", "--listen", "0.0.0.0:0"], 2, &["--token-file", "--insecure"]);
    let dir = folder();
    let token = show(&dir.path().join("token"));
    let (_service, address) = serve("127.0.0.1:0", &["--token-file", &token]);
    let scene = show(scene());
    let run = |name: &str| show(&dir.path().join(name));
    let args =
        |out: &str| ["run", &scene, "--out", out, "--until", "sky", "--masks", &address].map(str::to_owned);
    let refused = output(&args(&run("a")));
    assert_eq!(refused.status.code(), Some(4));
    assert!(text(&refused.stderr).contains("token"), "{}", text(&refused.stderr));
    let allowed = [&args(&run("b"))[..], &["--vision-token-file".into(), token]].concat();
    completes(&allowed);
    refuses(&["run", &scene, "--out", &run("c"), "--masks", "grpc://nobody"], 2, &["grpc://HOST:PORT"]);
    refuses(&["run", &scene, "--out", &run("d"), "--masks", "gpu:1"], 2, &["gpu:1"]);
}

/// The folder in which `pip` put what the example in Python needs; `None` with a line where it is missing.
fn python(test: &str) -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let packages = root.join("target/tools/python");
    let can = Command::new("python3")
        .args(["-c", "import grpc_tools, numpy"])
        .env("PYTHONPATH", &packages)
        .output();
    if can.is_ok_and(|output| output.status.success()) {
        return Some(packages);
    }
    eprintln!("skipped: {test}: python3 has no grpcio-tools and numpy (pip install -r .ci/python.txt)");
    None
}

#[test]
fn a_model_in_the_guides_python_server_makes_masks_and_answers_clicks_and_texts() {
    let test = "a_model_in_the_guides_python_server_makes_masks_and_answers_clicks_and_texts";
    let Some(packages) = python(test) else { return };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/guide/vision_server.py");
    let mut command = Command::new("python3");
    let models = ["flood-fill", "--texts", "colours", "--listen", "127.0.0.1:0"];
    command.arg(script).args(models).env("PYTHONPATH", packages);
    let (_service, address) = started(&mut command);
    let dir = folder();
    let run = dir.path().join("run");
    let (stdout, _) = completes(&again(&run, &["--masks", &address, "--json"]));
    assert!(stdout.contains("masks, clicks and refinement: flood fill by the vision service"), "{stdout}");
    assert!(stdout.contains("descriptors: built-in"), "it embeds nothing: {stdout}");
    let selected = select(&run, &["--vision-service", &address]);
    assert_eq!(selected.status.code(), Some(0), "{}", text(&selected.stderr));
    let summary = json(&std::fs::read(run.join("selections/it/summary.json")).expect("a summary"));
    assert!(summary["splats"].as_u64().is_some_and(|n| n > 0), "{summary}");
    let run_text = show(&run);
    let by_text = ["segment", &run_text, "--text", "red", "--vision-service", &address, "--json"];
    let answer = json(works(&by_text).as_bytes());
    let matches = answer["ranking"]["matches"].as_array().expect("a ranking");
    // Five texts with one embedding would have a share of .2 each.
    let differs = |m: &serde_json::Value| m["score"].as_f64().is_some_and(|score| (score - 0.2).abs() > 0.01);
    assert!(matches.iter().any(differs), "{answer}");
}
