//! A worker on a disk of its own that a scene fills, with a script that plays the part of `segwild run`.
#![cfg(unix)]

use segwild_farm::{
    ArtefactSession, BatchEvent, EmbeddedEngine, ErrorClass, FarmScene, Job, JobEngine, JobState, JobStatus,
    Needs, ObjectArtefacts, StopBatch, StopLevel, WorkerTerms, work,
};
use segwild_flow::Ledger;
use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

/// A file system of 4 MiB, unmounted when dropped; `None` where mounting is not allowed.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn mount(at: PathBuf) -> Option<SmallDisk> {
        std::fs::create_dir_all(&at).expect("a folder");
        let mount = Command::new("mount").args(["-t", "tmpfs", "-o", "size=4m", "tmpfs"]).arg(&at).output();
        mount.is_ok_and(|output| output.status.success()).then_some(SmallDisk(at))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

/// Works on a scene whose process ends with 0 and leaves not a byte on the disk of the worker, until there is nothing left to
/// do, or the worker takes no scenes. Returns what became of the scene.
fn worked(dir: &Path, folder: &Path) -> (EmbeddedEngine, JobStatus) {
    let template = dir.join("template.sqlite");
    Ledger::open(dir.join("made/run.sqlite")).expect("a ledger").copy_to(&template).expect("a copy");
    let program = dir.join("segwild");
    let script = format!(
        "#!/bin/sh\nmkdir -p \"$4\" && cp '{}' \"$4/run.sqlite\" || exit 6\n\
         dd if=/dev/zero of=\"$4/photos.bin\" bs=4096 2> /dev/null\nexit 0\n",
        template.display()
    );
    std::fs::write(&program, script).expect("a script");
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("it can run");
    let photos = dir.join("photos");
    std::fs::create_dir(&photos).expect("a folder");
    std::fs::write(photos.join("a.jpg"), "a photo").expect("a photo");
    let store = ObjectArtefacts::open(&dir.join("shared").display().to_string()).expect("a store");
    let artefacts = ArtefactSession::new(Arc::new(store));
    let photos = artefacts.store_folder(&photos, &|_| true).expect("it is stored");
    let scene = FarmScene { photos, settings: BTreeMap::new(), until: None };
    let engine = EmbeddedEngine::open(dir.join("jobs.sqlite")).expect("an engine");
    let payload = serde_json::to_string(&scene).expect("JSON");
    engine.publish(&Job::new("night/a", payload, Needs::default())).expect("it is published");
    let stop = StopBatch::default();
    let terms = WorkerTerms {
        engine: &engine,
        artefacts,
        folder: folder.to_owned(),
        budget: Needs { cores: 1, memory_bytes: 1 << 30, accelerators: 0 },
        accelerator: None,
        patience_s: 3600.0,
        store_every: Duration::from_secs(3600),
        least_free_bytes: 0,
        drain: true,
        program,
        classify: |_| ErrorClass::Retryable,
        stop: stop.clone(),
    };
    work(terms, &mut |event| {
        if matches!(event, BatchEvent::WorkerPaused { .. }) {
            stop.raise(StopLevel::Stop);
        }
    })
    .expect("it works");
    let job = engine.jobs().expect("it answers").remove(0);
    (engine, job)
}

#[test]
fn a_finished_run_is_stored_once_more_when_space_was_made() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let Some(disk) = SmallDisk::mount(dir.path().join("work")) else {
        eprintln!(
            "skipped: a_finished_run_is_stored_once_more_when_space_was_made: mounting is not allowed here"
        );
        return;
    };
    // What a scene left that went to another machine.
    let left = disk.0.join("runs/night/left");
    std::fs::create_dir_all(&left).expect("a folder");
    std::fs::write(left.join("model.bin"), vec![1; 1 << 20]).expect("there is space");
    let (_, job) = worked(dir.path(), &disk.0);
    assert_eq!((job.state, job.failures), (JobState::Done, 0), "{job:?}");
    assert!(job.outcome.as_ref().is_some_and(|outcome| outcome.contains("artefact")), "{job:?}");
    assert!(!left.exists() && !disk.0.join("runs/night/a").exists(), "what is stored needs no space here");
}

#[test]
fn a_finished_run_that_cannot_be_stored_stays_and_its_worker_takes_no_scenes() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let Some(disk) = SmallDisk::mount(dir.path().join("work")) else {
        eprintln!(
            "skipped: a_finished_run_that_cannot_be_stored_stays_and_its_worker_takes_no_scenes: mounting is not allowed here"
        );
        return;
    };
    let (engine, job) = worked(dir.path(), &disk.0);
    assert_eq!((job.state, job.failures), (JobState::Pending, 1), "{job:?}");
    let error = job.error.clone().unwrap_or_default();
    assert!(error.contains("its result could not be stored") && error.contains("the disk"), "{error}");
    assert!(disk.0.join("runs/night/a/run.sqlite").is_file(), "another attempt has only to store it");
    // A worker that has ended is none that takes no scenes.
    let tallies = engine.tallies().expect("it answers");
    assert!(!tallies.is_empty() && tallies.values().all(|tally| tally.paused.is_none()), "{tallies:?}");
}
