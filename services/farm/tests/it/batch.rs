//! A batch with programs that play the part of `segwild run`: shell scripts that succeed, fail, hang and are killed.
#![cfg(unix)]

use segwild_farm::{
    BatchError, BatchEvent, BatchFolder, BatchOptions, BatchSummary, ErrorClass, JobState, StopBatch,
    StopLevel, batch,
};
use segwild_flow::Ledger;
use segwild_flow::ledger::{LiveSample, LiveStage};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// What the script does is the name of the scene's folder: `run PATH --out OUT ..`.
const SCRIPT: &str = r#"#!/bin/sh
out=$4
mkdir -p "$out"
echo "$@" >> "$out/calls"
case $(basename "$2") in
  good*) exit 0;;
  bad) echo "error: photo.jpg is no image" >&2; exit 3;;
  flaky) [ "$(wc -l < "$out/calls")" -ge 2 ] && exit 0; echo "error: no luck" >&2; exit 4;;
  short) [ "$(wc -l < "$out/calls")" -ge 2 ] && exit 0; echo "error: too many open files" >&2; exit 8;;
  broken) echo "error: always" >&2; exit 4;;
  killed) kill -9 $$;;
  long) cat > /dev/null; echo "stopped" >&2; exit 130;;
  busy|idle) sleep 2; exit 0;;
  deaf) trap '' TERM; while :; do sleep 1; done;;
esac
"#;

fn classify(code: Option<i32>) -> ErrorClass {
    match code {
        Some(3) => ErrorClass::Fatal,
        Some(8) => ErrorClass::Shortage,
        _ => ErrorClass::Retryable,
    }
}

struct Yard {
    dir: tempfile::TempDir,
    options: BatchOptions,
}

impl Yard {
    fn new(manifest: &str) -> Yard {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let program = dir.path().join("segwild");
        std::fs::write(&program, SCRIPT).expect("a script");
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("it can run");
        std::fs::write(dir.path().join("batch.toml"), manifest).expect("a manifest");
        let options =
            BatchOptions { program, classify, stop: StopBatch::default(), retry_dead: false, until: None };
        Yard { dir, options }
    }

    fn folder(&self) -> PathBuf {
        self.dir.path().join("out")
    }

    fn run(&self, tell: &mut dyn FnMut(&BatchEvent)) -> Result<BatchSummary, BatchError> {
        batch::run(&self.dir.path().join("batch.toml"), &self.folder(), &self.options, tell)
    }

    fn calls(&self, scene: &str) -> Vec<String> {
        let text = std::fs::read_to_string(self.folder().join(scene).join("calls")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }
}

fn states(summary: &BatchSummary) -> Vec<(&str, JobState, u32)> {
    summary.scenes.iter().map(|s| (s.job.id.as_str(), s.state, s.attempt)).collect()
}

fn scenes(names: &[&str], more: &str) -> String {
    let head = "[budget]\ncores = 2\n[defaults]\nmemory = \"10 MiB\"\n".to_owned();
    names.iter().fold(head, |text, name| format!("{text}[[scene]]\npath = \"{name}\"\ncores = 1\n{more}"))
}

#[test]
fn a_failed_scene_does_not_stop_the_others_and_a_second_run_does_nothing_twice() {
    let yard = Yard::new(&scenes(&["bad", "good", "good2"], ""));
    let summary = yard.run(&mut |_| {}).expect("it runs");
    assert_eq!(
        states(&summary),
        [("bad", JobState::Dead, 1), ("good", JobState::Done, 1), ("good2", JobState::Done, 1)]
    );
    assert_eq!(summary.scenes[0].error.as_deref(), Some("photo.jpg is no image"));
    let call = &yard.calls("good")[0];
    assert!(
        call.contains("--config") && call.contains("--stop-with-parent") && call.contains("--threads"),
        "{call}"
    );
    // Nothing is left to do.
    let again = yard.run(&mut |event| panic!("{event:?}")).expect("it runs");
    assert_eq!(states(&again), states(&summary));
    // A dead letter tries again when that is requested.
    let options = BatchOptions { retry_dead: true, ..yard.options.clone() };
    let yard = Yard { options, ..yard };
    assert_eq!(states(&yard.run(&mut |_| {}).expect("it runs"))[0], ("bad", JobState::Dead, 2));
    assert_eq!((yard.calls("bad").len(), yard.calls("good").len()), (2, 1));
}

#[test]
fn another_attempt_is_made_where_it_may_help() {
    let yard = Yard::new(&scenes(&["flaky"], ""));
    let mut events = Vec::new();
    let summary = yard.run(&mut |event| events.push(event.clone())).expect("it runs");
    assert_eq!(states(&summary), [("flaky", JobState::Done, 2)]);
    let retried = events.iter().find_map(|event| match event {
        BatchEvent::SceneRetries { error, .. } => Some(error.as_str()),
        _ => None,
    });
    assert_eq!(retried, Some("no luck"));
}

#[test]
fn an_attempt_for_which_the_machine_had_no_file_descriptors_does_not_count() {
    let yard = Yard::new(&scenes(&["short"], "attempts = 1\n"));
    let mut events = Vec::new();
    let summary = yard.run(&mut |event| events.push(event.clone())).expect("it runs");
    assert_eq!(states(&summary), [("short", JobState::Done, 2)]);
    assert_eq!(summary.scenes[0].failures, 0);
    assert!(events.iter().any(|event| matches!(event, BatchEvent::SceneRetries { .. })), "{events:?}");
}

#[test]
fn a_killed_process_is_a_failure_in_words() {
    let yard = Yard::new(&scenes(&["killed", "broken"], "attempts = 1\n"));
    let summary = yard.run(&mut |_| {}).expect("it runs");
    assert_eq!(states(&summary), [("killed", JobState::Dead, 1), ("broken", JobState::Dead, 1)]);
    assert!(summary.scenes[0].error.as_deref().is_some_and(|e| e.contains("was killed")));
}

#[test]
fn a_stop_costs_no_attempt_and_the_next_run_goes_on() {
    let yard = Yard::new(&scenes(&["long"], ""));
    let stop = yard.options.stop.clone();
    let summary = yard
        .run(&mut |event| {
            if matches!(event, BatchEvent::SceneStarted { .. }) {
                stop.raise(StopLevel::Stop);
            }
        })
        .expect("it runs");
    assert!(summary.interrupted);
    assert_eq!((summary.scenes[0].state, summary.scenes[0].failures), (JobState::Pending, 0));
}

#[test]
fn a_scene_that_does_not_listen_is_ended_by_the_second_request() {
    let yard = Yard::new(&scenes(&["deaf"], ""));
    let stop = yard.options.stop.clone();
    let summary = yard
        .run(&mut |event| {
            if matches!(event, BatchEvent::SceneStarted { .. }) {
                stop.raise(StopLevel::AtOnce);
            }
        })
        .expect("it runs");
    assert!(summary.interrupted);
    assert_eq!(summary.scenes[0].failures, 0);
}

#[test]
fn a_process_in_which_nothing_moves_is_ended_and_tried_again() {
    let text = scenes(&["deaf"], "attempts = 1\n").replace("cores = 2\n", "cores = 2\npatience = 0.5\n");
    let yard = Yard::new(&text);
    let summary = yard.run(&mut |_| {}).expect("it runs");
    assert_eq!(states(&summary), [("deaf", JobState::Dead, 1)]);
    assert!(summary.scenes[0].error.as_deref().is_some_and(|e| e.starts_with("nothing moved for")));
}

/// Runs one scene that writes of itself, with a clock that is off by so many seconds, what a run's process writes:
/// units of work done. One more every 50 ms where it works.
fn run_under_a_clock_that_is_off(scene: &str, off_s: f64) -> BatchSummary {
    let text = scenes(&[scene], "attempts = 1\n").replace("cores = 2\n", "cores = 2\npatience = 0.6\n");
    let yard = Yard::new(&text);
    let out = yard.folder().join(scene);
    let works = scene == "busy";
    let (report_start, started) = mpsc::channel();
    let (ends_with_the_test, ended) = mpsc::channel::<()>();
    let writer = std::thread::spawn(move || {
        let pid = started.recv().expect("it starts");
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).expect("a clock").as_secs_f64() + off_s;
        let (mut ledger, mut done) = (None, 0);
        while let Err(mpsc::RecvTimeoutError::Timeout) = ended.recv_timeout(Duration::from_millis(50)) {
            done += u64::from(works);
            let stage = LiveStage { stage: "geometry".into(), done, ..LiveStage::default() };
            let sample =
                LiveSample { time: wall, pid, moved: wall, stages: vec![stage], ..LiveSample::default() };
            std::fs::create_dir_all(&out).expect("a folder");
            let ledger =
                ledger.get_or_insert_with(|| Ledger::open(out.join("run.sqlite")).expect("a ledger"));
            ledger.record_live(&sample, false).expect("it writes");
        }
    });
    let summary = yard.run(&mut |event| {
        if let BatchEvent::SceneStarted { pid, .. } = event {
            report_start.send(*pid).expect("somebody writes");
        }
    });
    drop(ends_with_the_test);
    writer.join().expect("it writes");
    summary.expect("it runs")
}

#[test]
fn a_clock_that_jumped_ahead_ends_no_process_that_works() {
    let summary = run_under_a_clock_that_is_off("busy", -7200.0);
    let scene = &summary.scenes[0];
    assert_eq!((scene.state, scene.failures), (JobState::Done, 0), "{:?}", scene.error);
}

#[test]
fn a_clock_that_jumped_back_hides_no_process_in_which_nothing_moves() {
    let summary = run_under_a_clock_that_is_off("idle", 7200.0);
    let scene = &summary.scenes[0];
    assert_eq!(scene.state, JobState::Dead);
    assert!(scene.error.as_deref().is_some_and(|e| e.starts_with("nothing moved for")), "{:?}", scene.error);
}

#[test]
fn budgets_are_kept() {
    // Two cores, three scenes of one core each and one that needs both.
    let text =
        scenes(&["good1", "good2", "good3"], "") + "[[scene]]\npath = \"good4\"\ncores = 2\npriority = 9\n";
    let yard = Yard::new(&text);
    let (mut now, mut most) = (0u32, 0u32);
    let mut cores = std::collections::BTreeMap::new();
    let mut order = Vec::new();
    let summary = yard.run(&mut |event| match event {
        BatchEvent::SceneStarted { scene, cores: granted, .. } => {
            now += granted;
            most = most.max(now);
            cores.insert(scene.clone(), *granted);
            order.push(scene.clone());
        }
        BatchEvent::SceneDone { scene, .. } => now -= cores[scene],
        other => panic!("{other:?}"),
    });
    assert_eq!(summary.expect("it runs").count(JobState::Done), 4);
    assert!(most <= 2, "{most} cores were given away at once");
    assert_eq!(order[0], "good4", "the most urgent one first");
}

#[test]
fn each_scene_gets_its_memory_budget_and_its_last_step() {
    let manifest = scenes(&["good", "good2"], "") + "until = 500\nmemory = \"1 GiB\"\n";
    let yard = Yard::new(&manifest);
    yard.run(&mut |_| {}).expect("it runs");
    let last_call = |scene: &str| yard.calls(scene).pop().unwrap_or_default();
    assert!(
        last_call("good").contains("--memory-budget 10 ") && !last_call("good").contains("--until"),
        "{}",
        last_call("good")
    );
    assert!(last_call("good2").contains("--memory-budget 1024 "), "{}", last_call("good2"));
    assert!(last_call("good2").ends_with("--until 500"), "{}", last_call("good2"));
    // The command line has the last word, and a scene that stops elsewhere is run again.
    let until = segwild_pipeline::Until::stage("geometry");
    let options = BatchOptions { until, ..yard.options.clone() };
    let yard = Yard { options, ..yard };
    let summary = yard.run(&mut |_| {}).expect("it runs");
    assert_eq!(states(&summary), [("good", JobState::Done, 2), ("good2", JobState::Done, 2)]);
    for scene in ["good", "good2"] {
        assert!(yard.calls(scene).pop().unwrap_or_default().ends_with("--until geometry"), "{scene}");
    }
}

/// The most accelerators that were given away at once, and the order in which scenes began.
fn accelerators_in_use(manifest: &str, per_scene: &dyn Fn(&str) -> u32) -> (u32, Vec<String>) {
    let yard = Yard::new(manifest);
    let (mut now, mut most, mut order) = (0, 0, Vec::new());
    let summary = yard.run(&mut |event| match event {
        BatchEvent::SceneStarted { scene, .. } => {
            now += per_scene(scene);
            most = most.max(now);
            order.push(scene.clone());
        }
        BatchEvent::SceneDone { scene, .. } => now -= per_scene(scene),
        other => panic!("{other:?}"),
    });
    assert_eq!(summary.expect("it runs").count(JobState::Done), order.len());
    (most, order)
}

#[test]
fn an_accelerator_is_had_by_one_scene_at_a_time_and_by_the_most_urgent_first() {
    let head =
        "[budget]\ncores = 8\naccelerators = 1\n[defaults]\ncores = 1\nmemory = \"10 MiB\"\n".to_owned();
    let wanting = ["good1", "good2", "good3"];
    let manifest = wanting.iter().enumerate().fold(head, |text, (i, name)| {
        format!("{text}[[scene]]\npath = \"{name}\"\naccelerators = 1\npriority = {i}\n")
    }) + "[[scene]]\npath = \"good-without\"\npriority = -1\n";
    let needs = |scene: &str| u32::from(wanting.contains(&scene));
    let (most, order) = accelerators_in_use(&manifest, &needs);
    assert_eq!(most, 1);
    // The one that needs none does not wait for those that do.
    assert_eq!(order, ["good3", "good-without", "good2", "good1"]);
}

#[test]
fn a_scene_that_needs_more_accelerators_than_there_are_is_refused_before_anything_starts() {
    let yard = Yard::new(&scenes(&["good", "good2"], "accelerators = 1\n"));
    let message = yard.run(&mut |event| panic!("{event:?}")).expect_err("there is none").to_string();
    assert!(
        message.contains("scene `good`") && message.contains("1 accelerator") && message.contains("budget"),
        "{message}"
    );
}

#[test]
fn one_batch_folder_has_one_batch() {
    let yard = Yard::new(&scenes(&["good"], ""));
    let folder = yard.folder();
    let (mut inner, mut owner) = (None, None);
    yard.run(&mut |event| {
        if matches!(event, BatchEvent::SceneStarted { .. }) {
            inner = yard.run(&mut |_| {}).err().map(|e| e.to_string());
            owner = BatchFolder::open(&folder).and_then(|f| f.owner());
        }
    })
    .expect("it runs");
    let message = inner.expect("the second batch is refused");
    assert!(message.contains(&format!("process {}", std::process::id())), "{message}");
    assert!(owner.is_some());
    let after = BatchFolder::open(&folder).expect("a batch");
    assert_eq!(after.owner(), None);
    assert_eq!(after.record().expect("a record").pid, std::process::id());
}

#[test]
fn a_scene_that_left_the_manifest_is_not_run() {
    let yard = Yard::new(&scenes(&["long", "good"], ""));
    let stop = yard.options.stop.clone();
    yard.run(&mut |_| stop.raise(StopLevel::Stop)).expect("it runs");
    std::fs::write(yard.dir.path().join("batch.toml"), scenes(&["good"], "")).expect("a manifest");
    let yard = Yard { options: BatchOptions { stop: StopBatch::default(), ..yard.options.clone() }, ..yard };
    let summary = yard.run(&mut |_| {}).expect("it runs");
    assert_eq!(summary.scenes.iter().map(|s| s.job.id.as_str()).collect::<Vec<_>>(), ["good"]);
}

#[test]
fn a_folder_that_is_no_batch_is_reported_as_none() {
    assert!(BatchFolder::open(Path::new("/nowhere")).is_none());
}
