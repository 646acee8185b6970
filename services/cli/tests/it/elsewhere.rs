//! A run whose machine dies goes on in another folder, as on another machine, to the same bytes.

use crate::common::*;
use segwild_farm::{ArtefactSession, ObjectArtefacts};
use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

fn session(dir: &tempfile::TempDir) -> ArtefactSession {
    let shared = show(&dir.path().join("shared"));
    ArtefactSession::new(Arc::new(ObjectArtefacts::open(&shared).expect("a shared folder")))
}

/// The command line of the finished run, of a scene in another folder.
fn of_scene(scene: &Path, out: &Path, more: &[&str]) -> Vec<String> {
    let mut args = again(out, more);
    args[1] = show(scene);
    args
}

/// The scene, as another machine fetches it.
fn scene_elsewhere(dir: &tempfile::TempDir) -> PathBuf {
    let into = dir.path().join("cache of inputs/scene");
    let digest = session(dir).store_folder(&shared_run().scene, &|_| true).expect("it is stored");
    session(dir).fetch_folder(&digest, &into).expect("it is fetched");
    into
}

#[test]
fn a_stopped_run_goes_on_elsewhere_from_its_checkpoint_to_the_same_bytes() {
    let dir = folder();
    let (run, elsewhere) = (dir.path().join("run"), dir.path().join("elsewhere/run"));
    completes(&again(&run, &["--until", "20"]));
    let digest = session(&dir).store_run(&run).expect("it is stored");
    std::fs::remove_dir_all(&run).expect("the machine is gone");
    session(&dir).fetch_run(&digest, &elsewhere).expect("it is fetched");
    let scene = scene_elsewhere(&dir);
    let (_, stderr) = completes(&of_scene(&scene, &elsewhere, &[]));
    assert!(stderr.contains("goes on from step 20"), "{stderr}");
    same_as_untouched(&elsewhere);
}

#[test]
fn a_run_that_is_killed_after_a_copy_goes_on_elsewhere_to_the_same_bytes() {
    let dir = folder();
    let (run, straight) = (dir.path().join("run"), dir.path().join("straight"));
    let longer = ["--steps", "800", "--checkpoint-every", "1"];
    let session = session(&dir);
    let digest = {
        let mut child = Guarded(start(&again(&run, &longer)));
        let has_checkpoint = || {
            let mut files = std::fs::read_dir(run.join("checkpoints")).into_iter().flatten().flatten();
            files.any(|file| file.path().extension().is_some_and(|e| e == "bin"))
        };
        wait_for(&mut child.0, "a checkpoint", has_checkpoint);
        // The worker stores it while it goes on; what comes after that is lost with the machine.
        let first = session.store_run(&run).expect("it is stored while it is written");
        let second = RefCell::new(first);
        wait_for(&mut child.0, "a later copy", || {
            second.replace(session.store_run(&run).expect("it is stored again"));
            *second.borrow() != first
        });
        let second = second.into_inner();
        child.0.kill().expect("it was running");
        second
    };
    let elsewhere = dir.path().join("elsewhere/run");
    session.fetch_run(&digest, &elsewhere).expect("it is fetched");
    let status = works(&["status", &show(&elsewhere)]);
    assert!(!status.contains("in use"), "{status}");
    let (_, stderr) = completes(&of_scene(&scene_elsewhere(&dir), &elsewhere, &longer));
    // On a busy machine the training may be over before the second copy.
    let goes_on = stderr.contains("goes on from step") || stderr.contains("geometry was done before");
    assert!(goes_on, "{stderr}");
    completes(&again(&straight, &longer));
    same_results(&elsewhere, &straight);
}
