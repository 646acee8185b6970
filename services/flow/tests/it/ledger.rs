//! The ledger's promises, also after a kill.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use segwild_flow::ledger::{CheckpointRow, SCHEMA_VERSION, State, ViewOutcome};
use segwild_flow::{Event, Events, Key, Ledger, LedgerError};

fn key(steps: u32) -> Key {
    Key::of("geometry").value("steps", steps).finish()
}

const CHILD: &str = "SEGWILD_LEDGER_CHILD";

/// Not a test of its own: in the child process it writes until it is killed.
#[test]
fn child_writer() {
    let Some(path) = std::env::var_os(CHILD) else { return };
    let ledger = Ledger::open(Path::new(&path)).unwrap();
    ledger.start_stage("masks", &key(1)).unwrap();
    let mut out = std::io::stdout();
    for n in 0.. {
        ledger.record_view("masks", &format!("{n:06}.jpg"), &key(1), &ViewOutcome::done(0.1)).unwrap();
        writeln!(out, "\nconfirmed {n}").unwrap();
        out.flush().unwrap();
    }
}

fn spawn_writer(path: &Path) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "ledger::child_writer", "--nocapture"])
        .env(CHILD, path)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
fn a_killed_writer_loses_nothing_it_confirmed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.sqlite");
    let mut confirmed = 0;
    for round in 1..=3 {
        let mut child = spawn_writer(&path);
        let pid = child.id();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let mut numbers =
            lines.map_while(Result::ok).filter_map(|l| l.strip_prefix("confirmed ")?.parse::<usize>().ok());
        let last = numbers.by_ref().nth(100).unwrap();

        // While it writes, others can read, and see who writes; a second writer is refused.
        let reader = Ledger::open_read_only(&path).unwrap();
        assert_eq!(reader.owner().unwrap().pid, Some(pid));
        assert!(reader.views("masks").unwrap().len() > last);
        assert_eq!(reader.stages().unwrap()[0].state, State::Running);
        assert!(matches!(reader.set_settings([("a", "b")]), Err(LedgerError::ReadOnly { .. })));
        let refused = Ledger::open(&path).unwrap_err();
        assert!(refused.to_string().contains(&format!("in use by process {pid}")), "{refused}");

        child.kill().unwrap();
        child.wait().unwrap();
        confirmed = confirmed.max(numbers.last().unwrap_or(last));
        assert_eq!(reader.owner(), None);
        let ledger = Ledger::open(&path).unwrap();
        assert!(ledger.views("masks").unwrap().len() > confirmed);
        let stage = &ledger.stages().unwrap()[0];
        assert_eq!(
            (stage.state, stage.runs),
            (State::Pending, round),
            "interrupted, and distinguished from running"
        );
        assert_eq!(ledger.last_events(1).unwrap()[0].message, "was interrupted; continues");
    }
}

#[test]
fn stages_are_done_under_their_key_only() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("deep/run.sqlite");
    {
        let ledger = Ledger::open(&path).unwrap();
        ledger.start_stage("geometry", &key(1)).unwrap();
        assert!(!ledger.stage_is_done("geometry", &key(1)).unwrap());
        ledger.finish_stage("geometry", &key(1), Some(2.5)).unwrap();
        ledger.start_stage("features", &key(2)).unwrap();
        ledger.fail_stage("features", &key(2), "no network").unwrap();
    }
    let ledger = Ledger::open(&path).unwrap();
    assert!(ledger.stage_is_done("geometry", &key(1)).unwrap());
    assert!(!ledger.stage_is_done("geometry", &key(2)).unwrap());
    assert!(!ledger.stage_is_done("features", &key(2)).unwrap());
    let stages = ledger.stages().unwrap();
    assert_eq!(
        stages.iter().map(|s| (s.name.as_str(), s.state)).collect::<Vec<_>>(),
        [("geometry", State::Done), ("features", State::Failed)]
    );
    assert_eq!((stages[0].cpu_s, stages[1].error.as_deref()), (Some(2.5), Some("no network")));
    assert!(stages[0].ended.unwrap() >= stages[0].started.unwrap());
    // Begun again under another key, it is no longer done under the first.
    ledger.start_stage("geometry", &key(9)).unwrap();
    assert!(!ledger.stage_is_done("geometry", &key(1)).unwrap());
    assert_eq!(ledger.stages().unwrap()[0].runs, 1);
}

#[test]
fn views_of_which_a_later_run_makes_nothing_are_forgotten() {
    let dir = tempfile::tempdir().unwrap();
    let ledger = Ledger::open(dir.path().join("run.sqlite")).unwrap();
    for stage in ["masks", "sky"] {
        for view in ["a.jpg", "b.jpg", "c.jpg"] {
            ledger.record_view(stage, view, &key(1), &ViewOutcome::cached()).unwrap();
        }
    }
    ledger.forget_other_views("masks", &["a.jpg", "c.jpg", "d.jpg"].into()).unwrap();
    let names = |stage: &str| -> Vec<String> {
        ledger.views(stage).unwrap().into_iter().map(|row| row.view).collect()
    };
    assert_eq!(names("masks"), ["a.jpg", "c.jpg"]);
    assert_eq!(names("sky").len(), 3);
}

#[test]
fn views_checkpoints_settings_and_events_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.sqlite");
    let bytes = b"splats";
    {
        let ledger = Ledger::open(&path).unwrap();
        ledger.record_view("masks", "b.jpg", &key(1), &ViewOutcome::failed(3, "too dark")).unwrap();
        ledger.record_view("masks", "a.jpg", &key(1), &ViewOutcome::cached()).unwrap();
        ledger.record_view("masks", "b.jpg", &key(1), &ViewOutcome::done(0.5)).unwrap();
        for step in [100, 300, 200] {
            ledger.record_checkpoint(&CheckpointRow::new("geometry", &key(1), step, "c.bin", bytes)).unwrap();
        }
        ledger.record_checkpoint(&CheckpointRow::new("geometry", &key(2), 900, "c.bin", bytes)).unwrap();
        ledger.set_settings([("steps", "3000"), ("old", "1")]).unwrap();
        ledger.set_settings([("steps", "500"), ("channels", "64")]).unwrap();
        let events = Events::new();
        let kept = ledger.clone();
        let sink = events.sink("ledger", move |record| kept.record_event(record).unwrap()).unwrap();
        events.warn(Some("masks"), "b.jpg is dark");
        events.metric("geometry", "loss", 0.5, Some(1));
        drop(sink);
    }
    let ledger = Ledger::open_read_only(&path).unwrap();
    let views = ledger.views("masks").unwrap();
    assert_eq!(views.iter().map(|v| v.view.as_str()).collect::<Vec<_>>(), ["a.jpg", "b.jpg"]);
    assert_eq!(views[1].outcome, ViewOutcome::done(0.5));
    let checkpoints = ledger.checkpoints("geometry", &key(1)).unwrap();
    assert_eq!(checkpoints.iter().map(|c| c.step).collect::<Vec<_>>(), [300, 200, 100]);
    assert!(checkpoints[0].fits(bytes) && !checkpoints[0].fits(b"splat"));
    let settings = ledger.settings().unwrap();
    assert_eq!(settings, [("channels".into(), "64".into()), ("steps".into(), "500".into())]);
    let events = ledger.last_events(10).unwrap();
    assert_eq!(events.len(), 1, "metrics are not kept");
    assert_eq!(events[0].level, "warning");
    let event: Event = serde_json::from_str(&events[0].message).unwrap();
    assert_eq!(event, Event::Warning { stage: Some("masks".into()), message: "b.jpg is dark".into() });
}

#[test]
fn other_formats_and_other_files_are_refused_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.sqlite");
    assert!(matches!(Ledger::open_read_only(&path), Err(LedgerError::Missing { .. })));
    drop(Ledger::open(&path).unwrap());
    let raw = rusqlite::Connection::open(&path).unwrap();
    raw.pragma_update(None, "user_version", SCHEMA_VERSION + 1).unwrap();
    drop(raw);
    for opened in [Ledger::open(&path), Ledger::open_read_only(&path)] {
        let error = opened.unwrap_err().to_string();
        assert!(error.contains("has ledger format 2, this program knows format 1"), "{error}");
    }
    std::fs::write(&path, b"this is no database, but long enough to be looked at as if it were one").unwrap();
    for opened in [Ledger::open(&path), Ledger::open_read_only(&path)] {
        let error = opened.unwrap_err();
        assert!(matches!(error, LedgerError::Damaged { .. }), "{error:?}");
        assert!(error.to_string().contains("move it away"), "{error}");
    }
    let foreign = folder.path().join("other.sqlite");
    rusqlite::Connection::open(&foreign).unwrap().execute_batch("CREATE TABLE t (x)").unwrap();
    assert!(matches!(Ledger::open(&foreign), Err(LedgerError::Damaged { .. })));
}

#[test]
fn a_view_in_somebody_elses_ledger_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.sqlite");
    drop(Ledger::open(&path).unwrap());
    let endless = "DROP TABLE stages; CREATE VIEW stages AS
        WITH RECURSIVE n (name) AS (SELECT 1 UNION ALL SELECT name + 1 FROM n) SELECT name FROM n;";
    rusqlite::Connection::open(&path).unwrap().execute_batch(endless).unwrap();
    for opened in [Ledger::open(&path), Ledger::open_read_only(&path)] {
        let error = opened.unwrap_err();
        assert!(matches!(error, LedgerError::Damaged { .. }), "{error:?}");
        assert!(error.to_string().contains("view `stages`"), "{error}");
    }
}

#[test]
fn a_trigger_in_somebody_elses_ledger_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.sqlite");
    drop(Ledger::open(&path).unwrap());
    let trigger = "CREATE TRIGGER t AFTER INSERT ON events BEGIN DELETE FROM stages; END;";
    rusqlite::Connection::open(&path).unwrap().execute_batch(trigger).unwrap();
    assert!(matches!(Ledger::open(&path), Err(LedgerError::Damaged { .. })));
}
