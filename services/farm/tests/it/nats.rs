//! The engine on JetStream goes through the conformance suite against a real server, and through what can happen to one.

#[path = "../../../../tests/support/nats_server.rs"]
mod nats_server;

use nats_server::NatsServer;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use segwild_farm::conformance::{Site, broken};
use segwild_farm::{
    ArtefactSession, Completed, EngineError, ErrorClass, FarmAccess, FarmAddress, FarmKey, FarmSweep,
    FarmSweepError, Job, JobEngine, JobState, NatsEngine, Needs, ObjectArtefacts, Retry, WorkerOffer,
};

const PATIENCE: Duration = Duration::from_secs(20);

fn engine_at(server: &NatsServer, name: &str) -> NatsEngine {
    NatsEngine::connect(&farm(server, name), &FarmAccess::default(), "test", PATIENCE).unwrap()
}

fn farm(server: &NatsServer, name: &str) -> FarmAddress {
    server.farm(name).parse().unwrap()
}

struct There {
    server: Arc<NatsServer>,
    name: String,
}

impl Site for There {
    fn engine(&self) -> Box<dyn JobEngine> {
        Box::new(engine_at(&self.server, &self.name))
    }
    fn pass(&self, seconds: f64) {
        engine_at(&self.server, &self.name).pass(seconds).unwrap();
    }
    // No wall clock of this machine plays a part; that of a server cannot be set here: `nats/clock.rs` tests it.
    fn jump(&self, _: f64) {}
}

#[test]
fn the_engine_on_jetstream_conforms() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let (server, count) = (Arc::new(server), AtomicU32::new(0));
    let site = || -> Box<dyn Site> {
        let name = format!("conforms-{}", count.fetch_add(1, Ordering::Relaxed));
        Box::new(There { server: server.clone(), name })
    };
    assert_eq!(broken(&site), []);
}

fn job(id: &str) -> Job {
    let retry = Retry { attempts: 3, first_delay_s: 0.5, longest_delay_s: 5.0 };
    let needs = Needs { cores: 1, ..Needs::default() };
    Job { retry, ..Job::new(id, "{}", needs) }
}

fn offer(worker: &str, lease_s: f64) -> WorkerOffer {
    WorkerOffer::all(worker, Needs { cores: 1, ..Needs::default() }, lease_s)
}

#[test]
fn a_lease_ends_by_the_servers_clock() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let (first, second) = (engine_at(&server, "f"), engine_at(&server, "f"));
    first.publish(&job("a")).unwrap();
    let lease = first.claim(&offer("first", 1.0)).unwrap().expect("a lease");
    assert!(second.claim(&offer("second", 1.0)).unwrap().is_none());
    let began = Instant::now();
    let heir = loop {
        if let Some(heir) = second.claim(&offer("second", 60.0)).unwrap() {
            break heir;
        }
        std::thread::park_timeout(Duration::from_millis(20));
    };
    // The lease, and the rest after it.
    assert!(began.elapsed() > Duration::from_millis(1400), "{:?}", began.elapsed());
    assert!(began.elapsed() < Duration::from_secs(15), "{:?}", began.elapsed());
    assert_eq!(heir.attempt, lease.attempt + 1);
    assert!(matches!(first.heartbeat(&lease), Err(EngineError::Lost { .. })));
}

#[test]
fn a_server_that_is_killed_again_and_again_loses_and_doubles_nothing() {
    const JOBS: usize = 60;
    let folder = tempfile::tempdir().unwrap();
    let Some(mut server) = NatsServer::start(folder.path()) else { return };
    let publisher = engine_at(&server, "f");
    for i in 0..JOBS {
        publisher.publish(&job(&format!("job {i}"))).unwrap();
    }
    let done = AtomicU32::new(0);
    let farm = farm(&server, "f");
    std::thread::scope(|scope| {
        for w in 0..3 {
            let (done, farm) = (&done, &farm);
            scope.spawn(move || {
                let name = format!("w{w}");
                let engine = NatsEngine::connect(farm, &FarmAccess::default(), &name, PATIENCE).unwrap();
                while let Some(lease) = engine.claim(&offer(&name, 60.0)).unwrap() {
                    let outcome = format!("{} by {name}", lease.job.id);
                    assert_eq!(engine.complete(&lease, &outcome).unwrap(), Completed::Now);
                    done.fetch_add(1, Ordering::Relaxed);
                    std::thread::park_timeout(Duration::from_millis(20));
                }
            });
        }
        for _ in 0..4 {
            std::thread::park_timeout(Duration::from_millis(120));
            server.kill();
            server.restart();
        }
    });
    assert_eq!(done.load(Ordering::Relaxed) as usize, JOBS);
    let jobs = publisher.jobs().unwrap();
    assert!(jobs.iter().all(|job| job.state == JobState::Done && job.attempt == 1), "{jobs:?}");
}

#[test]
fn a_log_is_compacted_and_a_new_machine_reads_the_same_jobs() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let engine = engine_at(&server, "f");
    for id in ["a", "b", "c"] {
        engine.publish(&job(id)).unwrap();
    }
    let done = engine.claim(&offer("w", 600.0)).unwrap().unwrap();
    engine.complete(&done, "done").unwrap();
    let held = engine.claim(&offer("w", 600.0)).unwrap().unwrap();
    let has = WorkerOffer { accelerator: Some("h100".into()), ..offer("w", 600.0) };
    engine.announce(&has).unwrap();
    let watcher = engine_at(&server, "f");
    while engine.records() < 2100 {
        engine.heartbeat(&held).unwrap();
    }
    assert_eq!(engine_at(&server, "f").jobs().unwrap(), engine.jobs().unwrap(), "one that starts");
    assert_eq!(watcher.jobs().unwrap(), engine.jobs().unwrap(), "one that had stopped to read before");
    assert_eq!(engine_at(&server, "f").watch(0, 100).unwrap(), engine.watch(0, 100).unwrap());
    // What operators see of it: who did what goes with the snapshot, and the log is as short as it was left.
    let reader = engine_at(&server, "f");
    let (tallies, log) = (reader.tallies().unwrap(), reader.log_state().expect("a log"));
    assert_eq!(tallies, engine.tallies().unwrap());
    assert_eq!((tallies["w"].done, tallies["w"].failed), (1, 0));
    assert_eq!((tallies["w"].whole, &tallies["w"].accelerator), (Some(has.whole), &has.accelerator));
    assert!(log.records < 100 && log.read_records < 100 && log.read_s > 0.0, "{log:?}");
    let writer = engine.log_state().expect("a log");
    assert!(writer.read_records >= 2100 && writer.records < 100, "{writer:?}");
    assert_eq!((log.void_records, writer.void_records), (0, 0));
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    let late = now - reader.log_time().expect("the log has a record");
    assert!((-1.0..60.0).contains(&late), "{late} s: the server's clock is this machine's");
    // The fence goes on.
    let later = engine_at(&server, "f");
    assert_eq!(later.complete(&held, "done").unwrap(), Completed::Now);
    assert!(matches!(engine.heartbeat(&held), Err(EngineError::Lost { .. })));
    let stored: u64 = walk(folder.path()).iter().map(|file| std::fs::metadata(file).unwrap().len()).sum();
    assert!(stored < 2 << 20, "{stored} bytes are kept of {} records", engine.records());
}

fn walk(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { walk(&path) } else { vec![path] }).collect()
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let to = to.join(entry.file_name());
        match entry.path().is_dir() {
            true => copy(&entry.path(), &to),
            false => assert!(std::fs::copy(entry.path(), to).is_ok()),
        }
    }
}

#[test]
fn a_server_that_lost_the_end_of_its_log_is_read_again() {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut server) = NatsServer::start(folder.path()) else { return };
    let (first, second) = (engine_at(&server, "f"), engine_at(&server, "f"));
    for id in ["a", "b"] {
        first.publish(&job(id)).unwrap();
    }
    // What a power cut leaves: the store as it was a moment ago.
    server.kill();
    copy(&folder.path().join("store"), &folder.path().join("before"));
    server.restart();
    let lost = first.claim(&offer("first", 60.0)).unwrap().unwrap();
    first.complete(&lost, "done").unwrap();
    assert_eq!(second.jobs().unwrap()[0].state, JobState::Done);
    server.kill();
    std::fs::remove_dir_all(folder.path().join("store")).unwrap();
    copy(&folder.path().join("before"), &folder.path().join("store"));
    server.restart();
    // Another handle goes on from there, so that the log is as long as before and another one.
    let third = engine_at(&server, "f");
    let again = third.claim(&offer("third", 60.0)).unwrap().unwrap();
    assert_eq!(again.job.id, "a", "it was done, and that is lost: it is done again");
    third.claim(&offer("third", 60.0)).unwrap().expect("b");
    assert!(matches!(first.complete(&lost, "done"), Err(EngineError::Lost { .. }) | Ok(Completed::Now)));
    assert_eq!(first.jobs().unwrap(), third.jobs().unwrap());
    assert_eq!(second.jobs().unwrap(), third.jobs().unwrap());
}

#[test]
fn who_does_not_have_the_key_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let with = |secret: &str| {
        let access = FarmAccess { key: Some(FarmKey::of(secret)), ..FarmAccess::default() };
        NatsEngine::connect(&farm(&server, "f"), &access, "test", Duration::from_secs(3)).unwrap()
    };
    let ours = with("secret");
    ours.publish(&job("a")).unwrap();
    let foreign = engine_at(&server, "f");
    foreign.publish(&job("b")).unwrap();
    let other = NatsEngine::connect(
        &farm(&server, "f"),
        &FarmAccess { key: Some(FarmKey::of("another")), ..FarmAccess::default() },
        "test",
        Duration::from_secs(3),
    )
    .unwrap();
    assert_eq!(other.jobs().unwrap().len(), 0);
    let names =
        |engine: &NatsEngine| engine.jobs().unwrap().into_iter().map(|j| j.job.id).collect::<Vec<_>>();
    assert_eq!(names(&ours), ["a"]);
    assert_eq!(names(&with("secret")), ["a"]);
    // It goes on after what is void.
    let lease = ours.claim(&offer("w", 60.0)).unwrap().expect("a lease");
    ours.fail(&lease, ErrorClass::Fatal, "bad input").unwrap();
    // Who sweeps the farm's artefacts with another key, or without one, would not know what it needs.
    let store = ObjectArtefacts::open(&folder.path().join("shared").display().to_string()).unwrap();
    let artefacts = ArtefactSession::new(Arc::new(store));
    for engine in [&other, &engine_at(&server, "f")] {
        let farms: Vec<(String, &dyn JobEngine)> = vec![("f".to_owned(), engine as &dyn JobEngine)];
        let older_than = Duration::ZERO;
        let sweep = FarmSweep { farms, artefacts: &artefacts, older_than, dry_run: true };
        let swept = sweep.sweep(&mut |_| ());
        assert!(matches!(swept, Err(FarmSweepError::OtherKey { .. })), "{swept:?}");
    }
    assert_eq!(with("secret").jobs().unwrap()[0].state, JobState::Dead);
}

#[test]
fn a_farm_that_cannot_be_reached_or_was_altered_is_named_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let connect = |address: &str| {
        let (address, patience) = (address.parse().unwrap(), Duration::from_millis(300));
        NatsEngine::connect(&address, &FarmAccess::default(), "test", patience).unwrap_err().to_string()
    };
    let message = connect("nats://127.0.0.1:1/x");
    assert!(message.starts_with("nats://127.0.0.1:1/x: no answer for"), "{message}");
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let engine = engine_at(&server, "f");
    for id in ["a", "b", "c"] {
        engine.publish(&job(id)).unwrap();
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let client = async_nats::connect(format!("127.0.0.1:{}", server.port)).await.unwrap();
        let stream = async_nats::jetstream::new(client).get_stream("SEGWILD_f").await.unwrap();
        stream.delete_message(3).await.unwrap();
    });
    let message = connect(&farm(&server, "f").to_string());
    assert!(message.contains("record 3 of the log is missing"), "{message}");
}
