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
    let mut args = again(run, &["--steps", "700", "--checkpoint-every", "1", "--photo-cache-mib", "0"]);
    args[1] = show(scene);
    args
}

#[test]
fn a_photo_that_changes_in_mid_training_is_named_and_spoils_nothing() {
    let dir = folder();
    let (scene, straight) = (dir.path().join("scene"), dir.path().join("straight"));
    copy_folder(&shared_run().scene, &scene);
    completes(&long(&scene, &straight));
    let expected = results(&straight);
    let view = &shared_run().manifest.photos[0].name;
    let photo = scene.join("images").join(view);
    let aside = dir.path().join("aside");
    std::fs::copy(&photo, &aside).expect("a copy");
    let other = scene.join("images").join(&shared_run().manifest.photos[1].name);
    type Change<'a> = (&'a str, &'a dyn Fn());
    let changes: [Change; 2] = [
        ("taken away", &|| std::fs::remove_file(&photo).expect("it goes")),
        ("another image", &|| std::fs::copy(&other, &photo).map(drop).expect("it is overwritten")),
    ];
    for (what, change) in changes {
        let run = dir.path().join(what);
        let output = disturbed(&scene, &run, change);
        let stdout = text(&output.stderr);
        assert_eq!(output.status.code(), Some(4), "{what}: {stdout}");
        assert!(stdout.contains(view) && stdout.contains("was changed or taken away"), "{what}: {stdout}");
        assert!(!run.join("model.bin").exists(), "{what}: nothing was made of it");
        // With the photo back, all is as if nothing had happened.
        std::fs::copy(&aside, &photo).expect("it is put back");
        completes(&long(&scene, &run));
        has_all_of(&run, &expected);
    }
}

#[test]
fn photos_that_cannot_be_used_are_named_and_the_rest_is_trained_to_the_end() {
    let dir = folder();
    let (scene, run) = (dir.path().join("scene"), dir.path().join("run"));
    copy_folder(&shared_run().scene, &scene);
    let photos: Vec<&str> =
        shared_run().manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.as_str()).collect();
    let file = |name: &str| scene.join("images").join(name);
    let size = segwild_scene::Image::read(&file(photos[0])).expect("an image");
    let masks = dir.path().join("away");
    std::fs::create_dir(&masks).expect("a folder");
    let all = segwild_scene::Mask::full(size.width as u32, size.height as u32);
    all.write_png(&masks.join(Path::new(photos[0]).with_extension("png"))).expect("a mask");
    let mut cut = std::fs::read(file(photos[1])).expect("a photo");
    let half = cut.len() / 2;
    cut[half..half + half / 2].fill(0);
    std::fs::write(file(photos[1]), cut).expect("it is damaged");
    let mut args = again(&run, &["--ignore", &show(&masks)]);
    args[1] = show(&scene);
    let (_, stderr) = completes(&args);
    for (name, reason) in [(photos[0], "masks leave nothing of it"), (photos[1], "does not decode")] {
        let line =
            stderr.lines().find(|line| line.contains(name)).unwrap_or_else(|| panic!("{name}: {stderr}"));
        assert!(
            line.contains("is left out") && (line.contains(reason) || line.contains("damaged")),
            "{line}"
        );
    }
    // Nothing is trained or computed a second time.
    args.push("--json".into());
    let (out, _) = completes(&args);
    assert_eq!(made(&out), 0, "{out}");
}
