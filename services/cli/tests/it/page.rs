//! `segwild serve`: its command line, and the page in a real browser.

use crate::common::*;
use crate::farm::nats_server::NatsServer;
use segwild_farm::{ErrorClass, FarmAccess, Job, JobEngine, NatsEngine, Needs, WorkerOffer};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// The tests of the page, in JavaScript.
fn browser_tests() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../studio/tests/browser")
}

/// Whether a program answers to `--version`.
fn is_there(program: &str) -> bool {
    Command::new(program).arg("--version").output().is_ok_and(|output| output.status.success())
}

/// Whether the browser starts here: some containers do not let it.
fn browser_starts() -> bool {
    let empty = [
        "60",
        "chromium",
        "--headless",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--dump-dom",
        "about:blank",
    ];
    Command::new("timeout").args(empty).output().is_ok_and(|output| output.status.success())
}

/// A farm with a machine that holds one scene, has done one and given one up; a fourth is too large for it.
fn small_farm(server: &NatsServer) -> String {
    let farm = server.farm("night");
    let (at, access) = (farm.parse().expect("an address"), FarmAccess::default());
    let engine = NatsEngine::connect(&at, &access, "test", Duration::from_secs(20)).expect("a farm");
    let needs = Needs { cores: 1, memory_bytes: 1 << 30, accelerators: 0 };
    for (name, cores) in [("dead", 1), ("done", 1), ("held", 1), ("huge", 64)] {
        let job = Job::new(format!("night/{name}"), "{}", Needs { cores, ..needs });
        engine.publish(&job).expect("it is handed in");
    }
    let whole = Needs { cores: 8, memory_bytes: 4 << 30, accelerators: 1 };
    let offer = WorkerOffer::all("machine-1", whole, 600.0);
    let offer = WorkerOffer { accelerator: Some("h100".into()), ..offer };
    engine.announce(&offer).expect("it answers");
    let claim = || engine.claim(&offer).expect("it answers").expect("a lease");
    engine.fail(&claim(), ErrorClass::Fatal, "bad input").expect("it is held");
    engine.complete(&claim(), "{}").expect("it is held");
    claim();
    farm
}

#[test]
fn the_page_does_what_a_person_wants_in_a_real_browser() {
    let tests = browser_tests();
    let missing = [
        (!is_there("node"), "Node.js is not installed"),
        (!tests.join("node_modules").is_dir(), "`npm ci` has not been run in services/studio/tests/browser"),
        (!browser_starts(), "Chromium is not installed, or does not start here"),
    ];
    if let Some((_, why)) = missing.iter().find(|(missing, _)| *missing) {
        println!("skipped: the_page_does_what_a_person_wants_in_a_real_browser: {why}");
        return;
    }
    let dir = folder();
    let queue = NatsServer::start(&dir.path().join("queue"));
    let output = Command::new("node")
        .args(["--test", "--test-concurrency=1", "."])
        .current_dir(&tests)
        .env("SEGWILD", env!("CARGO_BIN_EXE_segwild"))
        .env("SEGWILD_RUN", copied_run(&dir))
        .env("SEGWILD_FARM", queue.as_ref().map(small_farm).unwrap_or_default())
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
    // A queue that does not answer is no reason not to show the run.
    let silent = ["--farm", "nats://127.0.0.1:9/night"];
    let (mut child, line) = served(&[&silent[..], &[&*run, "--listen", "127.0.0.1:0"]].concat());
    assert!(line.contains("http://127.0.0.1:") && line.contains("/?token="), "{line}");
    signal(&child, "-INT");
    assert_eq!(child.wait().expect("it ends").code(), Some(0));
}

#[cfg(unix)]
#[test]
fn a_stop_after_the_run_closes_its_page_and_speaks_of_no_continuation() {
    let dir = folder();
    let mut child = start(&again(&copied_run(&dir), &["--serve"]));
    let mut lines = BufReader::new(child.stderr.take().expect("a pipe")).lines().map_while(Result::ok);
    assert!(lines.any(|line| line.contains("the page stays until Ctrl-C")), "it ended");
    signal(&child, "-INT");
    let rest: Vec<String> = lines.collect();
    assert_eq!(child.wait().expect("it ends").code(), Some(0), "{rest:?}");
    let has = |words: &str| rest.iter().any(|line| line.contains(words));
    assert!(has("closing the page") && !has("can continue"), "{rest:?}");
}

#[test]
fn other_machines_are_let_in_only_with_a_token_file_or_a_flag_that_says_so() {
    let dir = folder();
    let run = show(&copied_run(&dir));
    refuses(&["serve", &run, "--listen", "0.0.0.0:0"], 2, &["--token-file", "--insecure"]);
    refuses(&["serve", "no-such-folder"], 6, &["there is no such folder"]);
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).expect("a folder");
    refuses(&["serve", &show(&empty)], 6, &["there is no run in it"]);
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

#[test]
fn an_empty_token_file_is_refused_with_the_way_out() {
    let dir = folder();
    let file = dir.path().join("token");
    std::fs::write(&file, "").expect("it can be written");
    let run = show(&copied_run(&dir));
    refuses(&["serve", &run, "--token-file", &show(&file)], 2, &["16 letters", "delete the file"]);
}

#[test]
fn a_program_clicks_and_saves_an_object_through_the_api() {
    let dir = folder();
    let run = show(&copied_run(&dir));
    let client = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/guide/studio.py");
    if !is_there("python3") {
        println!("skipped: a_program_clicks_and_saves_an_object_through_the_api: Python is not installed");
        return;
    }
    let (mut child, line) = served(&[&run, "--listen", "127.0.0.1:0"]);
    let address = line.trim().trim_start_matches("the page: ").to_owned();
    let (_, click) = clearest();
    let at = format!("{},{}", click.x, click.y);
    let python = |args: &[&str]| {
        let output = Command::new("python3").arg(&client).args(args).current_dir(dir.path()).output();
        output.expect("python starts")
    };
    let output = python(&[&address, &click.photo, "--positive", &at, "--name", "statue"]);
    assert!(output.status.success(), "{}{}", text(&output.stdout), text(&output.stderr));
    assert!(text(&output.stdout).contains("splats"), "{}", text(&output.stdout));
    let splats = segwild_scene::ply::read(&dir.path().join("statue.ply")).expect("an object");
    assert!(!splats.is_empty());
    // The same name again is another object; a wrong token is refused in words.
    assert!(python(&[&address, &click.photo, "--positive", &at, "--name", "statue"]).status.success());
    let output = python(&[&(address + "0"), &click.photo, "--positive", &at]);
    assert!(text(&output.stderr).contains("has the token"), "{}", text(&output.stderr));
    child.kill().expect("it runs");
    child.wait().expect("it ends");
}

/// A request to a server whose first line is `line`; the answer's code and JSON.
fn request(line: &str, method: &str, path: &str, body: &serde_json::Value) -> (u16, serde_json::Value) {
    use std::io::{Read, Write};
    let address = line.trim().trim_start_matches("the page: http://");
    let (host, token) = address.split_once("/?token=").expect("an address");
    let body = body.to_string();
    let head = format!(
        "{method} /api/v1{path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\nAuthorization: Bearer {token}\r\n\
         Content-Length: {}\r\n\r\n{body}",
        body.len()
    );
    let mut stream = std::net::TcpStream::connect(host).expect("it listens");
    stream.write_all(head.as_bytes()).expect("it is sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    let (head, body) = answer.split_once("\r\n\r\n").expect("a head and a body");
    (head[9..12].parse().expect("a code"), json(body.as_bytes()))
}

#[test]
fn a_scene_is_trained_without_corrected_transients_and_its_objects_come_back() {
    let dir = folder();
    let run = copied_run(&dir);
    let name = run.file_name().expect("a name").to_string_lossy().into_owned();
    let (mut child, line) = served(&[&show(&run), "--listen", "127.0.0.1:0"]);
    let base = format!("/runs/{name}");
    let get = |path: &str| request(&line, "GET", &format!("{base}{path}"), &serde_json::json!(null));
    let act = |action: serde_json::Value| {
        let (code, state) = request(&line, "POST", &format!("{base}/act"), &action);
        assert_eq!(code, 200, "{state}");
        state
    };
    let description = until("the session", || Some(get("")).filter(|(code, _)| *code == 200)).1;
    let (_, click) = clearest();
    let photos = description["photos"].as_array().expect("photos");
    let photo = photos.iter().position(|p| p["name"] == click.photo.as_str()).expect("the photo");
    let point = serde_json::json!({ "x": click.x, "y": click.y, "inside": true });
    act(serde_json::json!({ "do": "prompt", "prompts": [{ "photo": photo, "points": [point] }] }));
    until("the answer", || (get("/state").1["answer"]["state"] == "done").then_some(()));
    act(serde_json::json!({ "do": "keep", "name": "statue" }));
    let other = photos.iter().position(|p| p["held_out"] == false).expect("a photo that is trained on");
    let side = |key: &str| photos[other]["camera"][key].as_f64().expect("a side");
    let corner = [0.0, side("height") * 0.7];
    let region = serde_json::json!({
        "shape": "polygon",
        "points": [corner, [side("width") * 0.4, corner[1]], [side("width") * 0.4, side("height")], [0.0, side("height")]],
    });
    let state =
        act(serde_json::json!({ "do": "transients", "photo": other, "region": region, "how": "add" }));
    assert_eq!(state["corrected"], serde_json::json!([other]));
    let before = std::fs::read(run.join("model.bin")).expect("the scene");
    assert_eq!(request(&line, "POST", &format!("{base}/train"), &serde_json::json!({})).0, 200);
    let after = until("the objects of the new scene", || {
        let (code, state) = get("/state");
        let again = state["notes"].to_string().contains("trained again");
        (code == 200 && again && state["objects"][0]["name"] == "statue").then_some(state)
    });
    assert!(after["objects"][0]["splats"].as_u64() > Some(0), "{after}");
    assert!(std::fs::read(run.join("model.bin")).expect("the scene") != before, "it was trained on");
    child.kill().expect("it runs");
    child.wait().expect("it ends");
}

#[test]
fn a_scene_of_a_batch_that_was_given_up_is_tried_again_from_the_page() {
    let dir = folder();
    let manifest = dir.path().join("scenes.toml");
    std::fs::write(&manifest, "[[scene]]\npath = \"broken\"\nattempts = 1\n").expect("a manifest");
    std::fs::create_dir(dir.path().join("broken")).expect("a folder that is no scene");
    let out = show(&dir.path().join("batch"));
    let given_up = segwild(&["batch", &show(&manifest), "--out", &out]);
    assert_eq!(given_up.status.code(), Some(4), "{}", text(&given_up.stderr));
    let (mut child, line) = served(&[&out, "--listen", "127.0.0.1:0"]);
    let null = serde_json::json!(null);
    let state = || request(&line, "GET", "/status", &null).1["scenes"][0]["state"].clone();
    assert_eq!(state(), "dead");
    assert_eq!(request(&line, "POST", "/scenes/nobody/retry", &null).0, 409);
    assert_eq!(request(&line, "POST", "/scenes/broken/retry", &null).0, 200);
    assert_eq!(state(), "waiting");
    assert_eq!(request(&line, "POST", "/scenes/broken/retry", &null).0, 409);
    child.kill().expect("it runs");
    child.wait().expect("it ends");
}
