//! The server: who may ask, what it answers, what it refuses.

use crate::common::run;
use segwild_farm::{EmbeddedEngine, ErrorClass, Job, JobEngine, Needs, WorkerOffer};
use segwild_monitor::view::FarmTarget;
use segwild_proto::Token;
use segwild_studio::{ServeOptions, StudioServer, serve, serve_farm};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How long anything may take before a test fails.
const LONGEST: Duration = Duration::from_secs(60);

/// A request without a token, and its whole answer.
fn raw(server: &StudioServer, request: &str) -> String {
    let mut stream = TcpStream::connect(server.socket()).unwrap();
    stream.set_read_timeout(Some(LONGEST)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut bytes = Vec::new();
    let _ = stream.read_to_end(&mut bytes);
    String::from_utf8_lossy(&bytes).into_owned()
}

fn request(server: &StudioServer, line: &str, headers: &str) -> String {
    let host = server.socket();
    raw(server, &format!("{line} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n{headers}\r\n"))
}

fn bearer(server: &StudioServer) -> String {
    format!("Authorization: Bearer {}\r\n", server.token().text())
}

/// What a server answers to a request with its token.
pub fn get(server: &StudioServer, path: &str) -> String {
    request(server, &format!("GET {path}"), &bearer(server))
}

fn post(server: &StudioServer, path: &str, body: &str) -> String {
    let host = server.socket();
    let head = format!(
        "POST {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\nContent-Length: {}\r\n{}\r\n",
        body.len(),
        bearer(server)
    );
    raw(server, &(head + body))
}

fn opened(server: &StudioServer, run: &str) {
    let began = Instant::now();
    while !get(server, &format!("/api/v1/runs/{run}")).starts_with("HTTP/1.1 200") {
        assert!(began.elapsed() < LONGEST, "{}", get(server, "/api/v1/runs"));
        std::thread::park_timeout(Duration::from_millis(20));
    }
}

fn is(response: &str, code: u16) -> bool {
    response.starts_with(&format!("HTTP/1.1 {code} "))
}

#[test]
fn nobody_gets_in_without_the_token_or_from_another_page() {
    let (_dir, folder) = run();
    let server = serve(folder.path(), ServeOptions::default()).unwrap();
    let (host, token) = (server.socket(), server.token().text().to_owned());
    for path in ["/", "/page/main.js", "/api/v1/runs", "/api/v1/status", "/nowhere"] {
        assert!(is(&request(&server, &format!("GET {path}"), ""), 401), "{path}");
    }
    assert!(is(&request(&server, "GET /api/v1/runs", "Authorization: Bearer 0000000000000000\r\n"), 401));
    assert!(is(&request(&server, "GET /?token=0000", ""), 401));
    // The address gives a cookie and forgets the token.
    let welcome = request(&server, &format!("GET /?token={token}"), "");
    assert!(is(&welcome, 303) && welcome.contains("location: /\r\n"), "{welcome}");
    let cookie = welcome.lines().find_map(|line| line.strip_prefix("set-cookie: ")).unwrap();
    assert!(cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"), "{cookie}");
    let cookie = format!("Cookie: other=1; {}\r\n", cookie.split(';').next().unwrap());
    let page = request(&server, "GET /", &cookie);
    assert!(is(&page, 200) && page.contains("/page/main.js"), "{page}");
    for header in
        ["content-security-policy: default-src 'none'; script-src 'self'", "x-content-type-options: nosniff"]
    {
        assert!(page.contains(header), "{header}");
    }
    assert!(!page.contains("unsafe") && !page.contains("<script>"), "{page}");
    // Another page, and a name that leads here.
    for origin in ["http://evil.example", "null", &format!("http://{host}.evil.example")] {
        assert!(
            is(&request(&server, "GET /api/v1/runs", &format!("{cookie}Origin: {origin}\r\n")), 403),
            "{origin}"
        );
    }
    assert!(is(&request(&server, "GET /api/v1/runs", &format!("{cookie}Origin: http://{host}\r\n")), 200));
    let elsewhere =
        format!("GET /api/v1/runs HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n{cookie}\r\n");
    assert!(is(&raw(&server, &elsewhere), 403));
    // Who goes on without the token waits; who has it does not.
    let refused = (0..200).map(|_| request(&server, "GET /", "")).find(|response| is(response, 429)).unwrap();
    assert!(refused.contains("retry-after: 1\r\n") && refused.contains("send this one again"), "{refused}");
    assert!(is(&request(&server, "GET /", &cookie), 200));
    // The token of one server is none of another's.
    let other = serve(folder.path(), ServeOptions::default()).unwrap();
    assert!(is(&request(&other, "GET /api/v1/runs", &bearer(&server)), 401));
    assert!(is(&request(&other, "GET /api/v1/runs", &cookie), 401));
}

#[test]
fn requests_name_no_path_and_no_run_that_is_not_listed() {
    let (_dir, folder) = run();
    let server = serve(folder.path(), ServeOptions::default()).unwrap();
    let name = folder.path().file_name().unwrap().to_str().unwrap().to_owned();
    opened(&server, &name);
    for path in [
        "/page/../../Cargo.toml",
        "/page/%2e%2e%2f%2e%2e%2fCargo.toml",
        "/api/v1/runs/..",
        "/api/v1/runs/%2e%2e%2fother",
        "/api/v1/runs/nobody",
        &format!("/api/v1/runs/{name}/photos/../../model.bin"),
        &format!("/api/v1/runs/{name}/photos/x"),
        &format!("/api/v1/runs/{name}/objects/7/%2e%2e"),
    ] {
        assert!(is(&get(&server, path), 404), "{path}: {}", get(&server, path));
    }
    assert!(is(&get(&server, &format!("/api/v1/runs/{name}/photos/999")), 400));
    for file in ["ply", "masks.zip", "coco.json"] {
        assert!(is(&get(&server, &format!("/api/v1/runs/{name}/objects/9/{file}")), 409), "{file}");
    }
    let none = get(&server, &format!("/api/v1/runs/{name}/export/masks.zip"));
    assert!(is(&none, 200) && none.contains("application/zip") && none.contains("provenance.json"), "{none}");
    let act = format!("/api/v1/runs/{name}/act");
    for body in [
        "",
        "{",
        "[]",
        "{\"do\":\"nothing\"}",
        "{\"do\":\"delete\",\"id\":1,\"more\":1}",
        "{\"do\":\"delete\",\"id\":\"../x\"}",
    ] {
        let response = post(&server, &act, body);
        assert!(is(&response, 400) && response.contains("\"error\""), "{body}: {response}");
    }
    assert!(is(&post(&server, &act, &"x".repeat(2 << 20)), 413));
    // Refusals by the router have the form of all others.
    let size = format!("/api/v1/runs/{name}/photos/0?size=-1");
    for (response, code, sentence) in [
        (get(&server, &size), 400, "query string"),
        (get(&server, "/api/v1/nothing"), 404, "nothing at this address"),
        (get(&server, "/page/nothing.js"), 404, "nothing at this address"),
        (post(&server, "/api/v1/runs", ""), 405, "of this method"),
    ] {
        assert!(is(&response, code) && response.contains(r#"{"error":""#), "{response}");
        assert!(response.contains(sentence), "{response}");
    }
    assert!(is(&post(&server, &act, "{\"do\":\"undo\"}"), 409));
}

#[test]
fn viewers_see_every_change_as_an_event() {
    let (_dir, folder) = run();
    let server = serve(folder.path(), ServeOptions::default()).unwrap();
    let name = folder.path().file_name().unwrap().to_str().unwrap().to_owned();
    opened(&server, &name);
    let follow = || {
        let mut stream = TcpStream::connect(server.socket()).unwrap();
        stream.set_read_timeout(Some(LONGEST)).unwrap();
        let (host, bearer) = (server.socket(), bearer(&server));
        let head = format!("GET /api/v1/runs/{name}/events HTTP/1.1\r\nHost: {host}\r\n{bearer}\r\n");
        stream.write_all(head.as_bytes()).unwrap();
        BufReader::new(stream)
    };
    let next = |stream: &mut BufReader<TcpStream>, part: &str| {
        let mut line = String::new();
        while !(line.starts_with("data: ") && line.contains(part)) {
            line.clear();
            assert!(stream.read_line(&mut line).unwrap() > 0, "the stream ended before {part}");
        }
    };
    let (mut one, mut two) = (follow(), follow());
    next(&mut one, "\"cut_spikes\":true");
    next(&mut two, "\"cut_spikes\":true");
    let done = post(&server, &format!("/api/v1/runs/{name}/act"), "{\"do\":\"cut_spikes\",\"cut\":false}");
    assert!(is(&done, 200), "{done}");
    next(&mut one, "\"cut_spikes\":false");
    next(&mut two, "\"cut_spikes\":false");
}

#[test]
fn a_folder_of_runs_lists_them_and_closes_the_one_that_was_used_longest_ago() {
    let dir = tempfile::tempdir().unwrap();
    let copies: Vec<_> = ["a", "b"]
        .iter()
        .map(|name| {
            let (own, folder) = run();
            std::fs::rename(folder.path(), dir.path().join(name)).unwrap();
            own
        })
        .collect();
    std::fs::create_dir(dir.path().join("no-run")).unwrap();
    let options =
        ServeOptions { memory_budget: 1, token: Token::of("a-token-of-my-own"), ..ServeOptions::default() };
    let server = serve(dir.path(), options).unwrap();
    assert_eq!(server.token().text(), "a-token-of-my-own");
    assert!(
        get(&server, "/api/v1/runs")
            .contains(r#"[{"name":"a","state":"trained"},{"name":"b","state":"trained"}]"#)
    );
    // The folder has no progress of its own; each run has.
    assert!(is(&get(&server, "/api/v1/status"), 503));
    let progress = get(&server, "/api/v1/status?run=b");
    assert!(is(&progress, 200) && progress.contains(r#""name":"b""#), "{progress}");
    for run in ["no-run", "..", "a%2F..%2Fb"] {
        assert!(is(&get(&server, &format!("/api/v1/status?run={run}")), 404), "{run}");
    }
    opened(&server, "a");
    opened(&server, "b");
    let list = get(&server, "/api/v1/runs");
    assert!(
        list.contains(r#"{"name":"a","state":"trained"}"#) && list.contains(r#"{"name":"b","state":"open"}"#),
        "{list}"
    );
    opened(&server, "a");
    drop(copies);
}

#[test]
fn a_run_that_is_not_trained_yet_is_waited_for() {
    let dir = tempfile::tempdir().unwrap();
    let server = serve(&dir.path().join("later"), ServeOptions::default()).unwrap();
    let response = get(&server, "/api/v1/runs/later");
    assert!(is(&response, 202) && response.contains("not trained yet"), "{response}");
    let training = || get(&server, "/api/v1/runs/later/training");
    assert!(training().ends_with(r#"{"photos":[],"history":[],"snapshot":null}"#), "{}", training());
    assert!(is(&get(&server, "/api/v1/runs/nobody/training"), 404));
    let (own, folder) = run();
    let model = std::fs::read(folder.path().join("model.bin")).unwrap();
    std::fs::remove_file(folder.path().join("model.bin")).unwrap();
    std::fs::remove_dir_all(folder.path().join("checkpoints")).unwrap();
    std::fs::rename(folder.path(), dir.path().join("later")).unwrap();
    // The photos and the curves are there before the first scene.
    assert!(is(&get(&server, "/api/v1/runs/later"), 202));
    assert!(training().contains("\"psnr\":") && training().contains("photo_003.png\""), "{}", training());
    let photo = |n: &str| get(&server, &format!("/api/v1/runs/later/training/photos/{n}"));
    assert!(is(&photo("0?size=64"), 200) && photo("0?size=64").contains("image/jpeg"));
    assert!(is(&photo("999"), 400) && is(&photo("%2e%2e"), 404));
    std::fs::write(dir.path().join("later/model.bin"), model).unwrap();
    opened(&server, "later");
    drop(own);
}

#[test]
fn a_run_that_cannot_be_opened_is_refused_until_its_files_are_whole() {
    let (_dir, folder) = run();
    let model = folder.path().join("model.bin");
    let whole = std::fs::read(&model).unwrap();
    std::fs::write(&model, &whole[..whole.len() / 2]).unwrap();
    let server = serve(folder.path(), ServeOptions::default()).unwrap();
    let name = folder.path().file_name().unwrap().to_str().unwrap().to_owned();
    let ask = || get(&server, &format!("/api/v1/runs/{name}"));
    let began = Instant::now();
    while is(&ask(), 202) {
        assert!(began.elapsed() < LONGEST, "it is never refused");
        std::thread::park_timeout(Duration::from_millis(20));
    }
    // Also while it is tried again.
    let refused = Instant::now();
    while refused.elapsed() < Duration::from_millis(2500) {
        let response = ask();
        assert!(is(&response, 503) && response.contains(r#"{"error":"the run `"#), "{response}");
        std::thread::park_timeout(Duration::from_millis(50));
    }
    std::fs::write(&model, whole).unwrap();
    opened(&server, &name);
}

#[test]
fn the_photos_of_a_run_that_is_about_to_start_are_shown() {
    let dir = tempfile::tempdir().unwrap();
    let photos = dir.path().join("photos");
    std::fs::create_dir(&photos).unwrap();
    let grey = segwild_scene::Image::filled(40, 30, 3, 0.5);
    ["b.jpg", "a.jpg"].iter().for_each(|name| std::fs::write(photos.join(name), grey.to_jpeg(90)).unwrap());
    let options = ServeOptions { photos: Some(photos), ..ServeOptions::default() };
    let server = serve(&dir.path().join("later"), options).unwrap();
    let training = get(&server, "/api/v1/runs/later/training");
    assert!(training.contains(r#""photos":["a.jpg","b.jpg"]"#), "{training}");
    assert!(is(&get(&server, "/api/v1/runs/later/training/photos/1"), 200));
    assert!(is(&get(&server, "/api/v1/runs/later/training/photos/2"), 400));
}

#[test]
fn a_farm_is_shown_with_and_without_a_folder() {
    let dir = tempfile::tempdir().unwrap();
    let engine = Arc::new(EmbeddedEngine::open(dir.path().join("jobs.sqlite")).unwrap());
    let farm = FarmTarget::new("nats://queue:4222/night", engine.clone());
    engine.publish(&Job::new("b/dead", "{}", Needs::default())).unwrap();
    let lease = engine.claim(&WorkerOffer::all("w", Needs::default(), 60.0)).unwrap().unwrap();
    engine.fail(&lease, ErrorClass::Fatal, "bad input").unwrap();
    let alone = serve_farm(farm.clone(), ServeOptions::default()).unwrap();
    assert!(get(&alone, "/api/v1/runs").ends_with("\r\n\r\n[]"), "{}", get(&alone, "/api/v1/runs"));
    for path in ["/api/v1/status", "/api/v1/farm"] {
        let answer = get(&alone, path);
        assert!(is(&answer, 200) && answer.contains("\"state\":\"dead\""), "{path}: {answer}");
    }
    assert!(is(&post(&alone, "/api/v1/farm/scenes/b%2Fnone/retry", ""), 409));
    assert!(is(&post(&alone, "/api/v1/farm/scenes/b%2Fdead/retry", ""), 200));
    assert!(get(&alone, "/api/v1/farm").contains("\"state\":\"waiting\""));
    assert!(is(&post(&alone, "/api/v1/scenes/b%2Fdead/retry", ""), 409), "it waits");
    // Beside a folder the status is the folder's, and a server without a farm shows none.
    let later = dir.path().join("later");
    let both = serve(&later, ServeOptions { farm: Some(farm.into()), ..ServeOptions::default() }).unwrap();
    assert!(is(&get(&both, "/api/v1/status"), 503) && is(&get(&both, "/api/v1/farm"), 200));
    let none = serve(&later, ServeOptions::default()).unwrap();
    assert!(get(&none, "/api/v1/farm").ends_with("\r\n\r\nnull"), "{}", get(&none, "/api/v1/farm"));
    let refused = post(&none, "/api/v1/farm/scenes/a/retry", "");
    assert!(is(&refused, 404) && refused.contains("--farm nats://HOST:PORT/NAME"), "{refused}");
}

#[test]
fn what_objects_change_is_sent_with_its_version() {
    let (_dir, folder) = run();
    let server = serve(folder.path(), ServeOptions::default()).unwrap();
    let name = folder.path().file_name().unwrap().to_str().unwrap().to_owned();
    opened(&server, &name);
    let response = get(&server, &format!("/api/v1/runs/{name}/changes"));
    assert!(is(&response, 200) && response.contains("segwild-version: \r\n"), "{response}");
}

#[test]
fn every_route_is_in_the_guide_and_every_route_of_the_guide_is_there() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let guide = std::fs::read_to_string(root.join("../../docs/guide/studio.md")).unwrap();
    let named = |text: &str| {
        text.replace("{run}", "RUN")
            .replace("{photo}", "N")
            .replace("{object}", "ID")
            .replace("{scene}", "SCENE")
    };
    let page = segwild_studio::openapi();
    let mut routes: Vec<String> = Vec::new();
    for (path, methods) in page["paths"].as_object().unwrap() {
        let path = named(path.strip_prefix("/api/v1").unwrap());
        routes.extend(methods.as_object().unwrap().keys().map(|m| format!("{} {path}", m.to_uppercase())));
    }
    let rows = guide.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next());
    let mut rows: Vec<String> = rows.map(|row| row.split('?').next().unwrap_or(row).to_owned()).collect();
    routes.sort();
    rows.sort();
    assert_eq!(routes, rows);
}
