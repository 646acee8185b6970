//! A batch as operators see it: its scenes, why they wait, and the terminal's page.

use crate::common::*;
use segwild_farm::{BatchFolder, BatchRecord, EmbeddedEngine, Job, JobEngine, Needs, WorkerOffer};
use segwild_monitor::metrics::render;
use segwild_monitor::view::{BatchView, FarmTarget, SceneState};
use segwild_monitor::{MonitorView, top};
use std::sync::Arc;

#[test]
fn a_batch_shows_its_scenes_and_why_they_wait() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (path, _ledger, lock) = batch_in(dir.path());
    let MonitorView::Batch(batch) = view(&path) else { panic!("a batch") };
    let states: Vec<_> = batch.scenes.iter().map(|s| s.state).collect();
    assert_eq!(states, [SceneState::Running, SceneState::Waiting, SceneState::Dead]);
    let why = |i: usize| batch.scenes[i].why.clone().unwrap_or_default();
    assert!(why(1).starts_with("tries again in") && why(1).ends_with("no luck"), "{}", why(1));
    assert_eq!(why(2), "given up: bad input");
    assert_eq!(batch.used.cores, 2);
    drop(lock);
    let MonitorView::Batch(batch) = view(&path) else { panic!("a batch") };
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
        let job = Job { priority, ..Job::new(name, "{}", needs) };
        engine.publish(&job).expect("it is published");
    }
    let offer = WorkerOffer::all("batch", budget, 1e9);
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
    let MonitorView::Batch(batch) = seen else { panic!("a batch") };
    let why: Vec<_> = batch.scenes.iter().skip(1).map(|s| s.why.clone().unwrap_or_default()).collect();
    assert_eq!(
        why,
        [
            "waits for 2 accelerators (1 free)",
            "waits for 1 accelerator; `urgent` goes first",
            "about to start"
        ]
    );
}

#[test]
fn a_scene_that_was_taken_and_cannot_start_names_what_it_waits_for() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let folder = BatchFolder::create(&dir.path().join("batch")).expect("a folder");
    let engine = EmbeddedEngine::open(folder.engine_file()).expect("an engine");
    let budget = Needs { cores: 2, memory_bytes: 1 << 30, accelerators: 0 };
    let needs = Needs { cores: 1, ..budget };
    let job = Job::new("held", "{}", needs);
    engine.publish(&job).expect("it is published");
    let offer = WorkerOffer::all("batch", budget, 1e9);
    let lease = engine.claim(&offer).expect("it works").expect("a lease");
    let record = BatchRecord { manifest: "b.toml".into(), budget, pid: std::process::id(), began: now() };
    let path = folder.path();
    std::fs::write(path.join("batch.json"), serde_json::to_vec(&record).expect("JSON")).expect("it writes");
    let lock = std::fs::File::create(path.join("batch.lock")).expect("a lock file");
    lock.lock().expect("it locks");
    let seen = || {
        let MonitorView::Batch(batch) = view(path) else { panic!("a batch") };
        (batch.scenes[0].state, batch.scenes[0].why.clone(), batch.used.cores)
    };
    engine.note_wait(&lease, Some("its run folder is in use by process 7")).expect("it is noted");
    let why = Some("its run folder is in use by process 7".to_owned());
    assert_eq!(seen(), (SceneState::Waiting, why, 1), "and its part of the budget is taken");
    engine.note_wait(&lease, None).expect("it is noted");
    assert_eq!(seen().0, SceneState::Running);
    engine.note_wait(&lease, Some("again")).expect("it is noted");
    engine.release(None, "the batch that held it ended early").expect("it is released");
    assert_eq!(seen().1.as_deref(), Some("about to start"), "nobody has taken it");
}

#[test]
fn cores_that_the_last_scene_was_lent_are_in_use() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (path, ledger, _lock) = batch_in(dir.path());
    let used = || match view(&path) {
        MonitorView::Batch(batch) => batch.used.cores,
        MonitorView::Run(_) => panic!("a batch"),
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
    engine.release(None, "the batch that held it ended early").expect("it is released");
    let free = Needs { cores: 2, memory_bytes: 8 << 30, accelerators: 0 };
    let offer = WorkerOffer::all("batch", free, 1e9);
    assert_eq!(engine.claim(&offer).expect("it works").expect("a lease").attempt, 2);
    let page = top::frame(&view(&path), 80, 24);
    let row = |name: &str| page.lines().find(|l| l[1..].starts_with(name)).expect("a row").to_owned();
    assert!(row("liberty").contains(" 0/3 masks+geometry") && row("liberty").contains(" 80.0 "), "{page}");
    assert!(row("bad").contains(" 1/3") && !row("bad").contains("0.0"), "{page}");
    let totals = page.lines().nth(1).expect("a line");
    assert!(totals.contains("cores 2 of 2") && !totals.ends_with('\u{2026}'), "nothing is cut: {totals}");
}

#[test]
fn a_farm_shows_what_its_machines_have_and_that_none_fits_a_scene() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let engine = Arc::new(EmbeddedEngine::open(dir.path().join("jobs.sqlite")).expect("an engine"));
    let target = FarmTarget::new("farm", engine.clone());
    let seen = || target.view().expect("a view");
    let small = Needs { cores: 1, memory_bytes: 1 << 30, accelerators: 0 };
    for (name, cores) in [("first", 1), ("second", 1), ("huge", 64)] {
        engine.publish(&Job::new(name, "{}", Needs { cores, ..small })).expect("it is published");
    }
    let why = |view: &BatchView| view.scenes[2].why.clone().unwrap_or_default();
    assert!(why(&seen()).ends_with("; no worker is there"), "{}", why(&seen()));
    let whole = Needs { cores: 8, memory_bytes: 4 << 30, accelerators: 0 };
    let offer = WorkerOffer::all("machine", whole, 60.0);
    engine.announce(&offer).expect("it works");
    let idle = seen().farm.expect("a farm").workers[0].clone();
    assert_eq!((idle.name.as_str(), idle.whole, idle.held), ("machine", Some(whole), 0));
    let claim = || engine.claim(&offer).expect("it works").expect("a lease");
    engine.complete(&claim(), "done").expect("it is held");
    assert_eq!(claim().job.id, "second");
    let view = seen();
    assert_eq!((view.budget, view.used), (whole, small));
    assert!(why(&view).ends_with("; of 1 worker none has that"), "{}", why(&view));
    let farm = view.farm.expect("a farm");
    assert_eq!((farm.workers[0].used, farm.workers[0].held, farm.workers[0].done), (small, 1, 1));
    assert!(farm.workers[0].done_per_hour > 0.0 && farm.workers[0].done_per_hour == farm.done_per_hour);
    assert!(farm.left_s.is_some_and(|left| left > 0.0), "{:?}", farm.left_s);
    assert_eq!(farm.past.iter().map(|sample| sample.done).sum::<u64>(), 1);
    // A machine that takes no scenes has what one needs, and is none that the scene waits for.
    engine.publish(&Job::new("third", "{}", small)).expect("it is published");
    let third = || seen().scenes[3].why.clone().unwrap_or_default();
    assert!(third().ends_with(" of memory"), "{}", third());
    engine.note_pause("machine", Some("its disk is full")).expect("it works");
    assert!(third().ends_with("; the one that has it takes no scene: its disk is full"), "{}", third());
    assert!(why(&seen()).ends_with("; of 1 worker none has that"), "{}", why(&seen()));
    let page = top::frame(&MonitorView::Batch(Box::new(seen())), 100, 24);
    assert!(page.contains("machines 1, 1 takes no scenes") && page.contains("its disk is full"), "{page}");
    engine.announce(&WorkerOffer::all("another", whole, 60.0)).expect("it works");
    assert!(third().ends_with(" of memory"), "another one takes it: {}", third());
    engine.note_pause("another", Some("its disk is read-only")).expect("it works");
    assert!(
        third().contains("the 2 that have it take no scene, as another: its disk is read-only"),
        "{}",
        third()
    );
}
