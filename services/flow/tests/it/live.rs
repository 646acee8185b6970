//! What other processes see of a run while it works and after it ended.

use segwild_flow::ledger::{LiveMailbox, LiveSample, LiveStage};
use segwild_flow::{
    Actor, ActorFailure, ActorOptions, Context, Event, Events, Ledger, Limits, Recorder, System,
    SystemOptions, WorkerState, mailbox, waiting_for,
};
use std::path::PathBuf;
use std::sync::mpsc;
use std::time::Duration;

fn folder() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("run.sqlite");
    (dir, path)
}

/// Waits in the middle of its work until it may go on.
struct Patient(mpsc::Receiver<()>, mpsc::Sender<()>);

impl Actor for Patient {
    type Message = String;
    fn handle(&mut self, _: String, _: &Context) -> Result<(), ActorFailure> {
        let _waiting = waiting_for("the sky of photo 3");
        self.1.send(()).expect("the test listens");
        let _ = self.0.recv();
        Ok(())
    }
}

/// Looks until the live view is as wanted.
fn until(path: &std::path::Path, wanted: impl Fn(&LiveSample) -> bool) -> LiveSample {
    let (_never, next) = mpsc::channel::<()>();
    for _ in 0..600 {
        // Another handle, as another process has.
        let seen = Ledger::open_read_only(path).expect("a ledger").live().expect("it reads");
        if let Some(seen) = seen.filter(&wanted) {
            return seen;
        }
        let _ = next.recv_timeout(Duration::from_millis(50));
    }
    panic!("the live view never became as wanted");
}

#[test]
fn a_worker_that_waits_is_seen_to_wait_and_for_what() {
    let (_dir, path) = folder();
    let ledger = Ledger::open(&path).expect("a ledger");
    let events = Events::new();
    let recorder = Recorder::start(&ledger, &events).expect("a recorder");
    let system = System::new(SystemOptions { events, ..SystemOptions::default() }).expect("a system");
    recorder.watch(system.observer());
    let (out, inbox) = mailbox::<String>("masks", Limits { count: 4, bytes: 1000 });
    let (go, went) = mpsc::channel();
    let (report_start, started) = mpsc::channel();
    let parts = std::sync::Mutex::new(Some((went, report_start)));
    system
        .spawn(inbox, ActorOptions::default(), move || {
            let (went, report_start) = parts.lock().expect("a lock").take().expect("it is built once");
            Ok(Patient(went, report_start))
        })
        .expect("an actor");
    out.blocking_send("a.jpg".into()).expect("space in the mailbox");
    out.blocking_send("b.jpg".into()).expect("space in the mailbox");
    started.recv().expect("it starts");
    let seen = until(&path, |s| s.actors.first().is_some_and(|a| a.workers[0].item.contains("sky")));
    let worker = &seen.actors[0].workers[0];
    assert_eq!((worker.state, worker.item.as_str()), (WorkerState::Blocked, "the sky of photo 3"));
    assert!(worker.since <= seen.time && seen.time - worker.since < 3600.0);
    assert_eq!(
        (seen.mailboxes[0].name.as_str(), seen.mailboxes[0].depth, seen.mailboxes[0].capacity),
        ("masks", 1, 4)
    );
    assert_eq!(seen.pid, std::process::id());
    drop((go, out));
    system.join();
    drop(recorder);
    let left = ledger.live().expect("it reads").expect("it stays");
    assert_eq!((left.actors[0].exit.as_str(), left.actors[0].messages), ("finished", 2));
    assert!(left.moved > left.began, "messages were handled");
    assert!(!ledger.past(10).expect("it reads").is_empty());
}

#[test]
fn a_stuck_worker_is_marked_until_it_moves() {
    let (_dir, path) = folder();
    let ledger = Ledger::open(&path).expect("a ledger");
    let events = Events::new();
    let recorder = Recorder::start(&ledger, &events).expect("a recorder");
    let system = System::new(SystemOptions::default()).expect("a system");
    recorder.watch(system.observer());
    let (go, went) = mpsc::channel::<()>();
    let mut went = Some(went);
    system
        .source("photos", ActorOptions::default(), move |_| {
            let _ = went.take().map(|w| w.recv());
            Ok(())
        })
        .expect("a source");
    let stuck = Event::ActorStuck { actor: "photos".into(), worker: 0, label: "a.jpg".into(), seconds: 60.0 };
    events.tell(stuck);
    until(&path, |s| s.actors.first().is_some_and(|a| a.workers[0].stuck));
    events.tell(Event::ActorRecovered { actor: "photos".into(), worker: 0 });
    until(&path, |s| s.actors.first().is_some_and(|a| !a.workers[0].stuck));
    drop(go);
    system.join();
}

#[test]
fn what_is_written_reads_back_the_same() {
    let (_dir, path) = folder();
    let ledger = Ledger::open(&path).expect("a ledger");
    assert_eq!(ledger.live().expect("it reads"), None, "nobody has watched it yet");
    let events = Events::new();
    events.metric("geometry", "loss", 0.1, Some(20)); // nobody listens yet
    let recorder = Recorder::start(&ledger, &events).expect("a recorder");
    events.metric("geometry", "loss", f64::NAN, Some(40));
    events.metric("geometry", "psnr_db", 21.5, Some(40));
    let _whole = events.stage("sky", Some(3));
    let mut in_parts = events.stage("geometry", Some(300));
    in_parts.next_part("short trainings", Some(100));
    drop(recorder);
    let seen = ledger.live().expect("it reads").expect("a sample");
    let parts: Vec<_> = seen.stages.iter().map(|s| (s.stage.as_str(), s.part.as_deref(), s.total)).collect();
    assert_eq!(parts, [("sky", None, Some(3)), ("geometry", Some("short trainings"), Some(100))]);
    let names: Vec<_> = seen.metrics.iter().map(|m| (m.name.as_str(), m.value, m.step)).collect();
    assert_eq!(names, [("psnr_db", 21.5, Some(40))], "a number that is none is left out");
    ledger.record_live(&seen, false).expect("it writes");
    assert_eq!(ledger.live().expect("it reads"), Some(seen));
}

#[test]
fn a_long_past_gets_coarser_and_never_longer() {
    let (_dir, path) = folder();
    let ledger = Ledger::open(&path).expect("a ledger");
    let at = |time| LiveSample {
        time,
        mailboxes: vec![LiveMailbox {
            name: "masks".into(),
            depth: 3,
            bytes: 0,
            capacity: 4,
            capacity_bytes: 0,
            high_water: 0,
            high_water_bytes: 0,
            sent: 0,
            received: 0,
            held_back: 0,
            waiting_senders: 0,
            back_pressure_s: 0.5,
            closed: false,
        }],
        ..LiveSample::default()
    };
    assert!(!ledger.thin_past().expect("it writes"));
    for second in 0..2001 {
        ledger.record_live(&at(f64::from(second)), true).expect("it writes");
    }
    assert!(ledger.thin_past().expect("it writes"));
    let past = ledger.past(usize::MAX).expect("it reads");
    assert_eq!((past.len(), past[1].time - past[0].time, past[0].depth), (1001, 2.0, 3));
    assert_eq!(ledger.past(2).expect("it reads").last().map(|p| p.time), Some(2000.0), "the last ones");
}

#[test]
fn a_ledger_from_before_the_parts_of_stages_still_reads() {
    let (_dir, path) = folder();
    let ledger = Ledger::open(&path).expect("a ledger");
    let stage = LiveStage { stage: "sky".into(), done: 4, ..LiveStage::default() };
    let seen = LiveSample { stages: vec![stage], ..LiveSample::default() };
    ledger.record_live(&seen, false).expect("it writes");
    drop(ledger);
    rusqlite::Connection::open(&path).expect("a database").execute("DROP TABLE parts", []).expect("it goes");
    let reader = Ledger::open_read_only(&path).expect("it is the same format");
    assert_eq!(reader.live().expect("it reads"), Some(seen));
}

#[test]
fn a_ledger_from_before_the_live_view_still_reads() {
    let (_dir, path) = folder();
    drop(Ledger::open(&path).expect("a ledger"));
    let old = rusqlite::Connection::open(&path).expect("a database");
    for table in ["live", "actors", "workers", "mailboxes", "progress", "parts", "metrics", "samples"] {
        old.execute(&format!("DROP TABLE {table}"), []).expect("it goes");
    }
    drop(old);
    let reader = Ledger::open_read_only(&path).expect("it is the same format");
    assert_eq!((reader.live().expect("it reads"), reader.past(9).expect("it reads")), (None, vec![]));
    // The next run adds what is missing.
    let writer = Ledger::open(&path).expect("it opens");
    writer.record_live(&LiveSample::default(), true).expect("it writes");
}
