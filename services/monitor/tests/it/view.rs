//! The view of a run made from its ledger as a run leaves it, whether it is ready, and the server.

use crate::common::*;
use segwild_flow::Ledger;
use segwild_flow::ledger::LiveSample;
use segwild_monitor::view::{RunState, Runs, SelectionView};
use segwild_monitor::{MonitorTarget, MonitorView, ready, serve};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::Path;

#[test]
fn everything_that_waits_says_why() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let _ledger = run_in(dir.path(), &sample());
    let run = run_view(dir.path());
    assert_eq!((run.state, run.running), (RunState::Running, true));
    let why = |name: &str| run.stages.iter().find(|s| s.name == name).and_then(|s| s.why.clone());
    assert_eq!(why("geometry"), None);
    assert_eq!(
        why("features").as_deref(),
        Some("waits for masks 1/4 (6.0 s left), geometry 500/1000 (6.2 s left)")
    );
    assert_eq!(
        why("objects").as_deref(),
        Some("waits for masks 1/4 (6.0 s left), geometry 500/1000 (6.2 s left)")
    );
    assert_eq!(why("report").as_deref(), Some("waits for evaluate, objects"));
    let why = |i: usize| run.actors[i].workers[0].why.clone().expect("a reason");
    assert_eq!(why(0), "waits for space in mailbox `coordinator`: 64 of 64 messages, 3.0 MiB of 64 MiB");
    assert!(why(1).starts_with("stuck: no progress on `a.jpg`"), "{}", why(1));
    assert_eq!(why(2), "no work until features can start");
    assert_eq!(why(3), "waits for the sky of photo 3");
    assert_eq!(run.failures.len(), 2);
    assert_eq!(run.left_s, Some(6.25), "stages overlap: the longest counts");
    assert_eq!(run.events[0].message, "10 isolated points are left out");
}

#[test]
fn a_stage_says_which_of_its_parts_is_under_way() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mut now = sample();
    let geometry = now.stages.iter_mut().find(|s| s.stage == "geometry").expect("it runs");
    geometry.part = Some("short trainings".into());
    let _ledger = run_in(dir.path(), &now);
    let run = run_view(dir.path());
    let stage = |name: &str| run.stages.iter().find(|s| s.name == name).expect("it is listed");
    assert_eq!(stage("geometry").part.as_deref(), Some("short trainings"));
    let why = stage("objects").why.as_deref();
    assert_eq!(
        why,
        Some("waits for masks 1/4 (6.0 s left), geometry (short trainings) 500/1000 (6.2 s left)")
    );
}

#[test]
fn a_run_that_was_killed_in_a_part_of_a_stage_has_not_the_counts_of_that_part() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let mut now = sample();
    let geometry = now.stages.iter_mut().find(|s| s.stage == "geometry").expect("it runs");
    geometry.part = Some("short trainings".into());
    drop(run_in(dir.path(), &now));
    let run = run_view(dir.path());
    let geometry = run.stages.iter().find(|s| s.name == "geometry").expect("it is listed");
    assert_eq!((geometry.state.as_str(), geometry.done, geometry.total), ("pending", 0, None));
}

#[test]
fn what_was_seen_stays_after_the_run() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let ledger = run_in(dir.path(), &sample());
    drop(ledger); // as if its process had been killed
    let run = run_view(dir.path());
    assert_eq!((run.state, run.owner.clone(), run.rss_bytes), (RunState::Stopped, None, None));
    assert_eq!(run.peak_rss_bytes, Some(430 << 20));
    assert_eq!(run.past.len(), 1);
    let masks = run.stages.iter().find(|s| s.name == "masks").expect("a stage");
    assert_eq!(
        (masks.state.as_str(), masks.why.as_deref()),
        ("pending", Some("no process works on this run"))
    );
    // The JSON form is the view, whole.
    let json = serde_json::to_string(&MonitorView::Run(Box::new(run.clone()))).expect("JSON");
    let MonitorView::Run(read) = serde_json::from_str(&json).expect("it reads back") else { panic!("a run") };
    // Not the floats: serde_json reads them back to the last bit but one.
    let stages = |run: &segwild_monitor::view::RunView| -> Vec<_> {
        run.stages.iter().map(|s| (s.name.clone(), s.state.clone(), s.done, s.total, s.why.clone())).collect()
    };
    assert_eq!(
        (stages(&read), read.folder, read.failures),
        (stages(&run), run.folder.clone(), run.failures.clone())
    );
}

#[cfg(unix)]
#[test]
fn a_run_folder_with_a_link_that_leads_out_is_not_called_no_run_folder() {
    let (folder, outside) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    drop(run_in(folder.path(), &sample()));
    std::os::unix::fs::symlink(outside.path(), folder.path().join("transients")).unwrap();
    let message = MonitorTarget::at(folder.path()).map(drop).unwrap_err().to_string();
    assert!(message.contains("transients") && !message.contains("no run folder"), "{message}");
}

#[test]
fn a_folder_that_is_neither_is_refused_in_words() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let message = MonitorTarget::at(dir.path()).map(drop).expect_err("nothing is there").to_string();
    assert!(message.contains("no run folder") && message.contains("segwild batch"), "{message}");
}

#[test]
fn readiness_lists_each_check() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let _ledger = run_in(dir.path(), &sample());
    let seen = view(dir.path());
    let checks: BTreeMap<String, bool> = ready(Ok(&seen)).into_iter().map(|c| (c.name, c.ok)).collect();
    assert_eq!((checks["ledger"], checks["live"], checks["actors"]), (true, true, false), "masks is stuck");
    let MonitorView::Run(mut run) = seen else { panic!("a run") };
    run.age_s = Some(600.0);
    run.disk = Some(segwild_monitor::view::Disk { free_bytes: 1 << 20, size_bytes: 1 << 40 });
    let seen = MonitorView::Run(run);
    let failed: Vec<String> = ready(Ok(&seen)).into_iter().filter(|c| !c.ok).map(|c| c.name).collect();
    assert_eq!(failed, ["live", "actors", "disk"]);
}

#[test]
fn a_run_that_nobody_works_on_is_not_read_again_until_something_changes() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let folder = dir.path();
    let target = |path: &Path| MonitorTarget::at(path).expect("a run");
    let mut runs = Runs::default();
    let mut read = || match target(folder).read(&mut runs).expect("a view") {
        MonitorView::Run(run) => *run,
        MonitorView::Batch(_) => panic!("this is a run"),
    };
    let ledger = run_in(folder, &sample());
    assert!(read().running);
    drop(ledger);
    let left = read();
    assert_eq!(left.state, RunState::Stopped, "the end of its process is seen");
    // A ledger whose content is changed under the same time and length is not read again.
    let file = folder.join("run.sqlite");
    let (bytes, time) = (std::fs::read(&file).expect("a file"), file.metadata().and_then(|m| m.modified()));
    let tamper = |bytes: &[u8]| {
        std::fs::write(&file, bytes).expect("it writes");
        let handle = std::fs::File::options().write(true).open(&file).expect("a file");
        handle.set_modified(*time.as_ref().expect("a time")).expect("it is set");
    };
    tamper(&vec![b'x'; bytes.len()]);
    let again = read();
    assert_eq!(again.stages, left.stages);
    assert!(again.time > left.time && again.age_s > left.age_s, "but time goes on");
    tamper(&bytes);
    // Work goes on, and a selection is made: both are seen at once.
    let mut moved = sample();
    moved.stages[2].done = 900;
    let ledger = Ledger::open(&file).expect("a ledger");
    ledger.record_live(&moved, true).expect("it writes");
    let done = |run: &segwild_monitor::view::RunView| run.stages.iter().map(|s| s.done).max();
    assert_eq!((read().running, done(&read())), (true, Some(900)));
    drop(ledger);
    assert_eq!(done(&read()), Some(900));
    assert!(read().selections.is_empty());
    std::fs::create_dir_all(folder.join("selections/statue")).expect("a folder");
    assert!(read().selections.is_empty(), "nothing is selected yet");
    std::fs::write(folder.join("selections/statue/prompts.json"), "{}").expect("it writes");
    let statue = |answered_s| [SelectionView { name: "statue".into(), answered_s }];
    assert_eq!(read().selections, statue(None));
    std::fs::write(folder.join("selections/statue/summary.json"), r#"{"select_s": 0.5}"#).expect("it writes");
    assert_eq!(read().selections, statue(Some(0.5)));
    let text = segwild_monitor::metrics::render(Some(&MonitorView::Run(Box::new(read()))), false);
    assert!(text.contains("segwild_interactive_latency_seconds_bucket{le=\"1\"} 1"), "{text}");
    assert!(text.contains("segwild_interactive_latency_seconds_count 1"), "{text}");
}

fn get(address: std::net::SocketAddr, path: &str) -> (u16, String) {
    let mut stream = std::net::TcpStream::connect(address).expect("it listens");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").expect("it is sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("it answers");
    let code = answer.split(' ').nth(1).and_then(|c| c.parse().ok()).expect("a status");
    (code, answer.split_once("\r\n\r\n").map_or(String::new(), |(_, body)| body.to_owned()))
}

#[test]
fn the_server_answers_before_during_and_after_a_run() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("run");
    let server = serve("127.0.0.1:0".parse().expect("an address"), path.clone(), false).expect("it listens");
    let at = server.address();
    assert_eq!(get(at, "/livez"), (200, "ok\n".into()));
    assert_eq!(get(at, "/readyz").0, 503, "there is no run yet");
    assert_eq!(get(at, "/api/v1/status").0, 503);
    assert!(get(at, "/metrics").1.contains("segwild_build_info"));
    let calm = LiveSample { actors: vec![], ..sample() };
    let ledger = run_in(&path, &calm);
    let (code, checks) = get(at, "/readyz");
    assert!(
        checks.contains("[+] live: 1 running") && (code == 200) == checks.contains("[+] disk"),
        "{checks}"
    );
    let (code, json) = get(at, "/api/v1/status");
    let json: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    assert_eq!((code, json["state"].as_str()), (200, Some("running")));
    drop(ledger);
    assert!(get(at, "/metrics").1.contains("segwild_scenes{state=\"waiting\"} 1"), "stopped, resumable");
    assert_eq!(get(at, "/nothing").0, 404);
    let second = serve(at, path, false).map(drop).expect_err("the address is taken").to_string();
    assert!(second.contains(&at.to_string()), "{second}");
    drop(server);
    assert!(std::net::TcpStream::connect(at).is_err(), "it is gone");
}
