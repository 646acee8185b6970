//! The view of runs and batches made from ledgers as a run leaves them, and each of its forms.

use segwild_farm::{
    BatchFolder, BatchRecord, EmbeddedEngine, Engine, ErrorClass, Job, Needs, Offer, Retry, SceneJob,
};
use segwild_flow::ledger::{LiveActor, LiveMailbox, LiveSample, LiveStage, LiveWorker, ViewOutcome};
use segwild_flow::{CacheCounters, Event, EventRecord, Key, Ledger, WorkerState};
use segwild_gateway::metrics::{Kind, Metric, render};
use segwild_gateway::view::{RunState, Runs, SceneState};
use segwild_gateway::{Target, View, ready, serve, top};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).expect("a clock").as_secs_f64()
}

fn worker(state: WorkerState, item: &str, stuck: bool) -> LiveWorker {
    LiveWorker { state, item: item.into(), since: now() - 90.0, stuck }
}

fn actor(name: &str, worker: LiveWorker) -> LiveActor {
    LiveActor {
        name: name.into(),
        exit: "running".into(),
        error: None,
        workers: vec![worker],
        messages: 12,
        retries: 2,
        restarts: 1,
        quarantined: 1,
        last_error: Some("b.jpg: it is no picture".into()),
        starting_s: 0.0,
        busy_s: 30.0,
        waiting_s: 10.0,
        blocked_s: 0.0,
        back_off_s: 0.0,
        cpu_s: 29.0,
    }
}

fn mailbox(name: &str, depth: u64) -> LiveMailbox {
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
fn sample() -> LiveSample {
    let stage = |stage: &str, done, total, rate, eta_s| LiveStage {
        stage: stage.into(),
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
fn run_in(folder: &Path, sample: &LiveSample) -> Ledger {
    std::fs::create_dir_all(folder).expect("a folder");
    let ledger = Ledger::open(folder.join("run.sqlite")).expect("a ledger");
    let key = |stage: &'static str| Key::of(stage).finish();
    for stage in ["sky", "embed"] {
        ledger.begin_stage(stage, &key(stage)).expect("it writes");
        ledger.record_view(stage, "a.jpg", &key(stage), &ViewOutcome::done(0.25)).expect("it writes");
        ledger.record_view(stage, "b.jpg", &key(stage), &ViewOutcome::cached()).expect("it writes");
        ledger.record_view(stage, "c.jpg", &key(stage), &ViewOutcome::failed(3, "torn")).expect("it writes");
        ledger.finish_stage(stage, &key(stage), Some(1.0)).expect("it writes");
    }
    ledger.begin_stage("masks", &key("masks")).expect("it writes");
    ledger.begin_stage("geometry", &key("geometry")).expect("it writes");
    let event =
        Event::Warning { stage: Some("geometry".into()), message: "10 isolated points are left out".into() };
    ledger.record_event(&EventRecord { time: now(), event }).expect("it writes");
    ledger.record_live(sample, true).expect("it writes");
    ledger
}

fn view(folder: &Path) -> View {
    Target::at(folder).and_then(|t| t.view()).expect("a view")
}

fn run_view(folder: &Path) -> segwild_gateway::view::RunView {
    match view(folder) {
        View::Run(run) => *run,
        View::Batch(_) => panic!("this is a run"),
    }
}

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
    assert_eq!(why("report").as_deref(), Some("waits for evaluate"));
    let why = |i: usize| run.actors[i].workers[0].why.clone().expect("a reason");
    assert_eq!(why(0), "waits for room at `coordinator`: 64 of 64 messages, 3.0 MiB of 64 MiB");
    assert!(why(1).starts_with("stuck: no progress on `a.jpg`"), "{}", why(1));
    assert_eq!(why(2), "no work until features can begin");
    assert_eq!(why(3), "waits for the sky of photo 3");
    assert_eq!(run.failures.len(), 2);
    assert_eq!(run.left_s, Some(6.25), "stages overlap: the longest counts");
    assert_eq!(run.events[0].message, "10 isolated points are left out");
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
    let json = serde_json::to_string(&View::Run(Box::new(run.clone()))).expect("JSON");
    let View::Run(read) = serde_json::from_str(&json).expect("it reads back") else { panic!("a run") };
    // Not the floats: serde_json reads them back to the last bit but one.
    let told = |run: &segwild_gateway::view::RunView| -> Vec<_> {
        run.stages.iter().map(|s| (s.name.clone(), s.state.clone(), s.done, s.total, s.why.clone())).collect()
    };
    assert_eq!(
        (told(&read), read.folder, read.failures),
        (told(&run), run.folder.clone(), run.failures.clone())
    );
}

#[test]
fn a_folder_that_is_neither_is_refused_in_words() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let said = Target::at(dir.path()).map(drop).expect_err("nothing is there").to_string();
    assert!(said.contains("no run folder") && said.contains("segwild batch"), "{said}");
}

#[test]
fn readiness_lists_each_check() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let _ledger = run_in(dir.path(), &sample());
    let seen = view(dir.path());
    let checks: BTreeMap<String, bool> = ready(Ok(&seen)).into_iter().map(|c| (c.name, c.ok)).collect();
    assert_eq!((checks["ledger"], checks["live"], checks["actors"]), (true, true, false), "masks is stuck");
    let View::Run(mut run) = seen else { panic!("a run") };
    run.age_s = Some(600.0);
    run.disk = Some(segwild_gateway::view::Disk { free_bytes: 1 << 20, size_bytes: 1 << 40 });
    let seen = View::Run(run);
    let failed: Vec<String> = ready(Ok(&seen)).into_iter().filter(|c| !c.ok).map(|c| c.name).collect();
    assert_eq!(failed, ["live", "actors", "disk"]);
}

/// Two scenes of three: one runs, one rests after a failure, one was given up.
fn batch_in(dir: &Path) -> (PathBuf, Ledger, std::fs::File) {
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
        let job = Job {
            id: (*name).into(),
            payload: serde_json::to_string(&scene).expect("JSON"),
            priority: 9 - i as i32,
            needs: Needs { cores: 2, memory_bytes: 1 << 30, accelerators: 0 },
            retry: Retry { first_delay_s: 1000.0, longest_delay_s: 1000.0, ..Retry::default() },
        };
        engine.publish(&job).expect("it is published");
        let free = Needs { cores: 2, memory_bytes: 8 << 30, accelerators: 0 };
        let offer = Offer { worker: "batch".into(), free, whole: free, lease_s: 1e9 };
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

#[test]
fn a_batch_shows_its_scenes_and_why_they_wait() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (path, _ledger, lock) = batch_in(dir.path());
    let View::Batch(batch) = view(&path) else { panic!("a batch") };
    let states: Vec<_> = batch.scenes.iter().map(|s| s.state).collect();
    assert_eq!(states, [SceneState::Running, SceneState::Waiting, SceneState::Dead]);
    let why = |i: usize| batch.scenes[i].why.clone().unwrap_or_default();
    assert!(why(1).starts_with("tries again in") && why(1).ends_with("no luck"), "{}", why(1));
    assert_eq!(why(2), "given up: bad input");
    assert_eq!(batch.used.cores, 2);
    drop(lock);
    let View::Batch(batch) = view(&path) else { panic!("a batch") };
    assert_eq!(batch.scenes[1].why.as_deref(), Some("no process runs this batch"));
}

#[test]
fn a_scene_that_waits_for_an_accelerator_says_so_and_who_goes_first() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let folder = BatchFolder::create(&dir.path().join("batch")).expect("a folder");
    let engine = EmbeddedEngine::open(folder.engine_file()).expect("an engine");
    let budget = Needs { cores: 4, memory_bytes: 4 << 30, accelerators: 2 };
    let wants = [("works", 9, 1), ("urgent", 5, 2), ("small", 1, 1), ("without", 0, 0)];
    for (name, priority, accelerators) in wants {
        let needs = Needs { cores: 1, memory_bytes: 1 << 20, accelerators };
        let job = Job { id: name.into(), payload: "{}".into(), priority, needs, retry: Retry::default() };
        engine.publish(&job).expect("it is published");
    }
    let offer = Offer { worker: "batch".into(), free: budget, whole: budget, lease_s: 1e9 };
    assert_eq!(engine.claim(&offer).expect("it works").expect("a lease").job.id, "works");
    let record = BatchRecord { manifest: "b.toml".into(), budget, pid: std::process::id(), began: now() };
    let path = folder.path();
    std::fs::write(path.join("batch.json"), serde_json::to_vec(&record).expect("JSON")).expect("it writes");
    let lock = std::fs::File::create(path.join("batch.lock")).expect("a lock file");
    lock.lock().expect("it locks");
    let seen = view(path);
    let page = top::frame(&seen, 100, 24);
    assert!(
        page.contains("accelerators 1 of 2") && page.contains("waits for 2 accelerators (1 free)"),
        "{page}"
    );
    let text = render(Some(&seen), false);
    assert!(text.contains("segwild_budget_accelerators{part=\"used\"} 1"), "{text}");
    let View::Batch(batch) = seen else { panic!("a batch") };
    let why: Vec<_> = batch.scenes.iter().skip(1).map(|s| s.why.clone().unwrap_or_default()).collect();
    assert_eq!(
        why,
        [
            "waits for 2 accelerators (1 free)",
            "waits for 1 accelerator; `urgent` goes first",
            "about to begin"
        ]
    );
}

#[test]
fn a_run_that_nobody_works_on_is_not_read_again_until_something_changes() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let folder = dir.path();
    let target = |path: &Path| Target::at(path).expect("a run");
    let mut runs = Runs::default();
    let mut look = || match target(folder).look(&mut runs).expect("a view") {
        View::Run(run) => *run,
        View::Batch(_) => panic!("this is a run"),
    };
    let ledger = run_in(folder, &sample());
    assert!(look().running);
    drop(ledger);
    let left = look();
    assert_eq!(left.state, RunState::Stopped, "the end of its process is seen");
    // A ledger whose content is changed behind the back of its time and length is not looked at.
    let file = folder.join("run.sqlite");
    let (bytes, time) = (std::fs::read(&file).expect("a file"), file.metadata().and_then(|m| m.modified()));
    let tamper = |bytes: &[u8]| {
        std::fs::write(&file, bytes).expect("it writes");
        let handle = std::fs::File::options().write(true).open(&file).expect("a file");
        handle.set_modified(*time.as_ref().expect("a time")).expect("it is set");
    };
    tamper(&vec![b'x'; bytes.len()]);
    let again = look();
    assert_eq!(again.stages, left.stages);
    assert!(again.time > left.time && again.age_s > left.age_s, "but time goes on");
    tamper(&bytes);
    // Work goes on, and a selection is made: both are seen at once.
    let mut moved = sample();
    moved.stages[2].done = 900;
    let ledger = Ledger::open(&file).expect("a ledger");
    ledger.record_live(&moved, true).expect("it writes");
    let done = |run: &segwild_gateway::view::RunView| run.stages.iter().map(|s| s.done).max();
    assert_eq!((look().running, done(&look())), (true, Some(900)));
    drop(ledger);
    assert_eq!(done(&look()), Some(900));
    assert!(look().selections.is_empty());
    std::fs::create_dir_all(folder.join("selections/statue")).expect("a folder");
    assert!(look().selections.is_empty(), "nothing is selected yet");
    std::fs::write(folder.join("selections/statue/prompts.json"), "{}").expect("it writes");
    assert_eq!(look().selections, ["statue"]);
}

#[test]
fn cores_that_the_last_scene_was_lent_are_in_use() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (path, ledger, _lock) = batch_in(dir.path());
    let used = || match view(&path) {
        View::Batch(batch) => batch.used.cores,
        View::Run(_) => panic!("a batch"),
    };
    assert_eq!(used(), 2, "as it needs");
    ledger.set_settings([("threads", "7")]).expect("it writes");
    assert_eq!(used(), 7);
    drop(ledger);
    assert_eq!(used(), 2, "its process is gone");
}

#[test]
fn top_fits_a_small_terminal_and_says_why() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (path, _ledger, _lock) = batch_in(dir.path());
    for (folder, words) in [
        (
            path.join("liberty"),
            &["geometry", "80.0/s", "18/64", "7.5", "412 MiB", "stuck: no progress", "9 hit 4 miss"][..],
        ),
        (
            path.clone(),
            &["1 waiting, 1 running, 1 dead", ">liberty", "given up: bad input", "tries again in", "stuck"],
        ),
    ] {
        let seen = view(&folder);
        let page = top::frame(&seen, 80, 24);
        for word in words {
            assert!(page.contains(word), "`{word}` is missing:\n{page}");
        }
        assert!(page.lines().count() <= 24 && page.lines().all(|l| l.chars().count() <= 80), "{page}");
        // Any size, however silly, is drawn without a panic.
        for (width, height) in [(1, 1), (20, 3), (300, 90)] {
            let page = top::frame(&seen, width, height);
            assert!(page.lines().count() <= usize::from(height));
        }
    }
}

#[test]
fn a_scene_that_does_not_run_has_no_rates_and_an_attempt_that_was_cut_short_is_no_failure() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (path, _ledger, _lock) = batch_in(dir.path());
    let engine = EmbeddedEngine::open(path.join("batch.sqlite")).expect("an engine");
    engine.release_all("the batch that held it ended early").expect("it is released");
    let free = Needs { cores: 2, memory_bytes: 8 << 30, accelerators: 0 };
    let offer = Offer { worker: "batch".into(), free, whole: free, lease_s: 1e9 };
    assert_eq!(engine.claim(&offer).expect("it works").expect("a lease").attempt, 2);
    let page = top::frame(&view(&path), 80, 24);
    let row = |name: &str| page.lines().find(|l| l[1..].starts_with(name)).expect("a row").to_owned();
    assert!(row("liberty").contains(" 0/3 masks+geometry") && row("liberty").contains(" 80.0 "), "{page}");
    assert!(row("bad").contains(" 1/3") && !row("bad").contains("0.0"), "{page}");
    let totals = page.lines().nth(1).expect("a line");
    assert!(totals.contains("cores 2 of 2") && !totals.ends_with('\u{2026}'), "nothing is cut: {totals}");
}

#[test]
fn metric_names_follow_the_rules() {
    let mut names = BTreeSet::new();
    for &metric in Metric::ALL {
        let name = metric.name();
        assert!(names.insert(name), "{name} is there twice");
        assert!(
            name.starts_with("segwild_") && name.chars().all(|c| c.is_ascii_lowercase() || c == '_'),
            "{name}"
        );
        assert_eq!(name.ends_with("_total"), metric.kind() == Kind::Counter, "{name}");
        assert!(metric.help().ends_with('.'), "{name}");
    }
}

#[test]
fn the_operators_page_explains_every_metric() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/operators.md");
    let page = std::fs::read_to_string(page).expect("the page");
    for &metric in Metric::ALL {
        let row = page.lines().find(|l| {
            let rest = l.strip_prefix("| `").and_then(|l| l.strip_prefix(metric.name()));
            rest.is_some_and(|rest| rest.starts_with(['`', '{']))
        });
        let row = row.unwrap_or_else(|| panic!("{} is not on the page", metric.name()));
        assert!(metric == Metric::BuildInfo || row.contains(metric.help()), "{row}");
    }
}

#[test]
fn the_metrics_text_holds_the_view() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (path, _ledger, _lock) = batch_in(dir.path());
    let text = render(Some(&view(&path)), false);
    for line in [
        "segwild_scenes{state=\"running\"} 1",
        "segwild_dead_letters 1",
        "segwild_scene_retries_total 1",
        "segwild_stage_views_total{stage=\"sky\",outcome=\"failed\"} 1",
        "segwild_stage_task_duration_seconds_bucket{stage=\"sky\",le=\"0.3\"} 1",
        "segwild_stage_task_duration_seconds_count{stage=\"sky\"} 1",
        "segwild_mailbox_depth{actor=\"masks\"} 18",
        "segwild_backpressure_seconds_total{actor=\"masks\"} 7.5",
        "segwild_actor_stuck{actor=\"masks\"} 1",
        "segwild_actor_stuck{actor=\"trainer\"} 0",
        "segwild_cache_requests_total{result=\"corrupt\"} 1",
        "segwild_cache_requests_total{result=\"miss\"} 3",
        "segwild_stage_queue_depth{stage=\"geometry\"} 500",
        "segwild_budget_cores{part=\"declared\"} 2",
    ] {
        assert!(text.lines().any(|l| l == line), "`{line}` is missing:\n{text}");
    }
    assert!(!text.contains("liberty"), "no scene is a label");
    assert!(render(Some(&view(&path)), true).contains("{scene=\"liberty\",actor=\"masks\"}"));
    promtool_agrees(&text);
    assert!(render(None, false).contains("segwild_build_info"));
}

/// `promtool check metrics` has nothing to say about names, units and help texts.
fn promtool_agrees(text: &str) {
    let promtool = std::process::Command::new("promtool")
        .args(["check", "metrics"])
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn();
    let Ok(mut promtool) = promtool else {
        println!("skipped: promtool check metrics: promtool is not installed (apt-get install prometheus)");
        return;
    };
    promtool.stdin.take().expect("a pipe").write_all(text.as_bytes()).expect("it reads");
    let output = promtool.wait_with_output().expect("it ends");
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.trim().is_empty(), "{said}");
}

fn get(address: std::net::SocketAddr, path: &str) -> (u16, String) {
    let mut stream = std::net::TcpStream::connect(address).expect("it listens");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").expect("it hears");
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
