//! Photos that change while a run uses them.

use crate::common::*;
use std::path::Path;
use std::process::Output;

/// Runs a scene, and does something to its photos when the training is under way.
fn disturbed(scene: &Path, run: &Path, disturb: impl FnOnce()) -> Output {
    let mut child = start(&long(scene, run));
    let history = run.join("history.jsonl");
    wait_for(&mut child, "the training", || std::fs::read(&history).is_ok_and(|text| !text.is_empty()));
    disturb();
    child.wait_with_output().expect("it ends")
}

/// A training that takes a while, with room for no photo.
fn long(scene: &Path, run: &Path) -> Vec<String> {
    let mut args = again(run, &["--steps", "1500", "--checkpoint-every", "1", "--photo-cache-mib", "0"]);
    args[1] = show(scene);
    args
}

#[test]
fn a_photo_that_changes_in_mid_training_is_named_and_spoils_nothing() {
    let dir = folder();
    let (scene, straight) = (dir.path().join("place"), dir.path().join("straight"));
    copy_folder(&place().scene, &scene);
    completes(&long(&scene, &straight));
    let expected = results(&straight);
    let view = &place().manifest.photos[0].name;
    let photo = scene.join("images").join(view);
    let aside = dir.path().join("aside");
    std::fs::copy(&photo, &aside).expect("a copy");
    let other = scene.join("images").join(&place().manifest.photos[1].name);
    type Change<'a> = (&'a str, &'a dyn Fn());
    let changes: [Change; 2] = [
        ("taken away", &|| std::fs::remove_file(&photo).expect("it goes")),
        ("another picture", &|| std::fs::copy(&other, &photo).map(drop).expect("it is overwritten")),
    ];
    for (what, change) in changes {
        let run = dir.path().join(what);
        let output = disturbed(&scene, &run, change);
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(3), "{what}: {said}");
        assert!(said.contains(view) && said.contains("was changed or taken away"), "{what}: {said}");
        assert!(!run.join("model.bin").exists(), "{what}: nothing was made of it");
        // With the photo back, all is as if nothing had happened.
        std::fs::copy(&aside, &photo).expect("it is put back");
        completes(&long(&scene, &run));
        has_all_of(&run, &expected);
    }
}
