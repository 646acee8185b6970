//! Runs and batches as they are left on the disk, for the tests to read.

use segwild_farm::{
    BatchFolder, BatchRecord, EmbeddedEngine, ErrorClass, Job, JobEngine, Needs, Retry, SceneJob, WorkerOffer,
};
use segwild_flow::ledger::{LiveActor, LiveMailbox, LiveSample, LiveStage, LiveWorker, ViewOutcome};
use segwild_flow::{CacheCounters, Event, EventRecord, Key, Ledger, WorkerState};
use segwild_monitor::{MonitorTarget, MonitorView};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

pub fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).expect("a clock").as_secs_f64()
}

pub fn worker(state: WorkerState, item: &str, stuck: bool) -> LiveWorker {
    LiveWorker { state, item: item.into(), since: now() - 90.0, stuck }
}

pub fn actor(name: &str, worker: LiveWorker) -> LiveActor {
    LiveActor {
        name: name.into(),
        exit: "running".into(),
        error: None,
        workers: vec![worker],
        messages: 12,
        retries: 2,
        restarts: 1,
        quarantined: 1,
        last_error: Some("b.jpg: it is no image".into()),
        starting_s: 0.0,
        busy_s: 30.0,
        waiting_s: 10.0,
        blocked_s: 0.0,
        back_off_s: 0.0,
        cpu_s: 29.0,
    }
}

pub fn mailbox(name: &str, depth: u64) -> LiveMailbox {
    LiveMailbox {
        name: name.into(),
        depth,
        bytes: 3 << 20,
        capacity: 64,
        capacity_bytes: 64 << 20,
        high_water: 64,
        high_water_bytes: 4 << 20,
        sent: 80,
        received: 16,
        held_back: 3,
        waiting_senders: 1,
        back_pressure_s: 7.5,
        closed: false,
    }
}

/// A run in the middle of its work: geometry and masks run, masks is stuck, the trainer is held back.
pub fn sample() -> LiveSample {
    let stage = |stage: &str, done, total, rate, eta_s| LiveStage {
        stage: stage.into(),
        part: None,
        done,
        total: Some(total),
        rate,
        eta_s,
    };
    LiveSample {
        time: now(),
        pid: std::process::id(),
        began: now() - 100.0,
        moved: now() - 5.0,
        rss_bytes: Some(412 << 20),
        peak_rss_bytes: Some(430 << 20),
        threads: Some(9),
        cpu_s: Some(150.0),
        cache: CacheCounters { hits: 9, misses: 4, corrupt: 1, bytes_read: 1000, bytes_written: 2000 },
        actors: vec![
            actor("trainer", worker(WorkerState::Blocked, "coordinator", false)),
            actor("masks", worker(WorkerState::Busy, "a.jpg", true)),
            actor("features", worker(WorkerState::Waiting, "", false)),
            actor("intrinsic renders", worker(WorkerState::Blocked, "the sky of photo 3", false)),
        ],
        mailboxes: vec![mailbox("masks", 18), mailbox("coordinator", 64)],
        stages: vec![
            stage("sky", 4, 4, 0.0, Some(0.0)),
            stage("embed", 4, 4, 0.0, Some(0.0)),
            stage("geometry", 500, 1000, 80.0, Some(6.25)),
            stage("masks", 1, 4, 0.5, Some(6.0)),
        ],
        metrics: vec![],
    }
}

/// Writes a run's ledger; while the handle lives, the run is being worked on.
pub fn run_in(folder: &Path, sample: &LiveSample) -> Ledger {
    std::fs::create_dir_all(folder).expect("a folder");
    let ledger = Ledger::open(folder.join("run.sqlite")).expect("a ledger");
    let key = |stage: &'static str| Key::of(stage).finish();
    for stage in ["sky", "embed"] {
        ledger.start_stage(stage, &key(stage)).expect("it writes");
        ledger.record_view(stage, "a.jpg", &key(stage), &ViewOutcome::done(0.25)).expect("it writes");
        ledger.record_view(stage, "b.jpg", &key(stage), &ViewOutcome::cached()).expect("it writes");
        ledger.record_view(stage, "c.jpg", &key(stage), &ViewOutcome::failed(3, "torn")).expect("it writes");
        ledger.finish_stage(stage, &key(stage), Some(1.0)).expect("it writes");
    }
    ledger.start_stage("masks", &key("masks")).expect("it writes");
    ledger.start_stage("geometry", &key("geometry")).expect("it writes");
    let event =
        Event::Warning { stage: Some("geometry".into()), message: "10 isolated points are left out".into() };
    ledger.record_event(&EventRecord { time: now(), event }).expect("it writes");
    ledger.record_live(sample, true).expect("it writes");
    ledger
}

pub fn view(folder: &Path) -> MonitorView {
    MonitorTarget::at(folder).and_then(|t| t.view()).expect("a view")
}

pub fn run_view(folder: &Path) -> segwild_monitor::view::RunView {
    match view(folder) {
        MonitorView::Run(run) => *run,
        MonitorView::Batch(_) => panic!("this is a run"),
    }
}

/// Two scenes of three: one runs, one rests after a failure, one was given up.
pub fn batch_in(dir: &Path) -> (PathBuf, Ledger, std::fs::File) {
    let path = dir.join("batch");
    let folder = BatchFolder::create(&path).expect("a folder");
    let engine = EmbeddedEngine::open(folder.engine_file()).expect("an engine");
    let mut leases = Vec::new();
    for (i, name) in ["liberty", "flaky", "bad"].iter().enumerate() {
        let scene = SceneJob {
            name: (*name).into(),
            path: dir.join(name),
            out: path.join(name),
            settings: BTreeMap::new(),
            until: None,
        };
        let needs = Needs { cores: 2, memory_bytes: 1 << 30, accelerators: 0 };
        let job = Job {
            priority: 9 - i as i32,
            retry: Retry { first_delay_s: 1000.0, longest_delay_s: 1000.0, ..Retry::default() },
            ..Job::new(*name, serde_json::to_string(&scene).expect("JSON"), needs)
        };
        engine.publish(&job).expect("it is published");
        let free = Needs { cores: 2, memory_bytes: 8 << 30, accelerators: 0 };
        let offer = WorkerOffer::all("batch", free, 1e9);
        leases.push(engine.claim(&offer).expect("it works").expect("a lease"));
    }
    engine.fail(&leases[1], ErrorClass::Retryable, "no luck").expect("it fails");
    engine.fail(&leases[2], ErrorClass::Fatal, "bad input").expect("it fails");
    let budget = Needs { cores: 2, memory_bytes: 4 << 30, accelerators: 0 };
    let record = BatchRecord { manifest: dir.join("b.toml"), budget, pid: std::process::id(), began: now() };
    std::fs::write(path.join("batch.json"), serde_json::to_vec(&record).expect("JSON")).expect("it writes");
    let lock = std::fs::File::create(path.join("batch.lock")).expect("a lock file");
    lock.lock().expect("it locks");
    let ledger = run_in(&path.join("liberty"), &sample());
    (path, ledger, lock)
}
