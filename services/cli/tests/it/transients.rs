//! Transients: masks of what was left out, corrected by hand, and obeyed.

use crate::common::{QUICK, copied_run, folder, refuses, scene, segwild, shared_run, show, text, works};
use segwild_scene::Mask;
use std::path::Path;

fn again(run: &Path, flags: &[&str]) -> Vec<String> {
    [&["run", &show(scene()), "--out", &show(run)][..], &QUICK, flags]
        .concat()
        .iter()
        .map(ToString::to_string)
        .collect()
}

fn runs(run: &Path, flags: &[&str]) -> String {
    let args = again(run, flags);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let output = segwild(&args);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    text(&output.stdout) + &text(&output.stderr)
}

/// Stage by stage, whether it would be reused.
fn plan(run: &Path, flags: &[&str]) -> Vec<(String, bool, String)> {
    let stdout = runs(run, &[&["--explain", "--json"], flags].concat());
    stdout
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
        .filter_map(|plan| {
            let reused = plan["verdict"] == "reused";
            Some((plan["stage"].as_str()?.to_owned(), reused, plan["why"].to_string()))
        })
        .collect()
}

#[test]
fn a_png_put_back_wins_and_what_depends_on_it_is_made_again() {
    let dir = folder();
    let run = copied_run(&dir);
    let trained: Vec<&str> =
        shared_run().manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.as_str()).collect();
    let image = |photo: &str| run.join("transients").join(Path::new(photo).with_extension("png"));
    for photo in &trained {
        assert!(image(photo).is_file(), "{photo} has a mask");
    }
    let model = || std::fs::read(run.join("model.bin")).expect("a model");
    let before = model();
    let all_reused = |plans: &[(String, bool, String)]| plans.iter().all(|p| p.1 || p.0 == "report");
    assert!(all_reused(&plan(&run, &[])), "nothing was changed: {:?}", plan(&run, &[]));
    // The same pixels, saved again by an editor, are no correction.
    let (photo, file) = (trained[2], image(trained[2]));
    let mask = Mask::read_png(&file).expect("it opens");
    let (w, h) = (mask.width() as usize, mask.height() as usize);
    let grey = segwild_scene::Image {
        width: w,
        height: h,
        channels: 1,
        data: (0..w * h).map(|i| if mask.index(i) { 0.8 } else { 0.0 }).collect(),
    };
    grey.write_png(&file).expect("it is written");
    assert!(all_reused(&plan(&run, &[])), "{:?}", plan(&run, &[]));

    // Another half of the photo is painted white.
    let put_right = Mask::from_fn(mask.width(), mask.height(), |x, _| x < mask.width() / 2);
    put_right.write_png(&file).expect("it is written");
    let plans = plan(&run, &[]);
    for (stage, reused, why) in &plans {
        let independent = matches!(stage.as_str(), "sky" | "embed");
        assert_eq!(*reused, independent, "{stage}: {why}");
        assert!(independent || stage != "geometry" || why.contains(photo), "{stage}: {why}");
    }
    let stdout = runs(&run, &[]);
    assert!(stdout.contains("put right by hand") && stdout.contains(photo), "{stdout}");
    let after = model();
    assert!(after != before, "another mask, another scene");
    assert_eq!(
        Mask::read_png(&file).expect("it is there"),
        put_right,
        "a person's mask is never written over"
    );
    assert!(all_reused(&plan(&run, &[])), "and it is obeyed once: {:?}", plan(&run, &[]));

    // From a folder elsewhere it is the same mask, and so the same scene.
    let given = dir.path().join("given");
    std::fs::create_dir(&given).expect("a folder");
    std::fs::copy(&file, given.join(file.file_name().expect("a name"))).expect("a copy");
    let given = show(&given);
    std::fs::remove_file(&file).expect("it goes");
    assert!(all_reused(&plan(&run, &["--transient-masks", &given])));
    // Taken back, the run is what it was.
    runs(&run, &[]);
    assert!(model() == before, "without the correction the first scene is there again");
    assert!(file.is_file(), "and its mask");
}

#[test]
fn a_correction_is_trained_on_from_where_the_training_ended() {
    let start = || {
        let dir = folder();
        let run = copied_run(&dir);
        (dir, run)
    };
    let (_kept, run) = start();
    let photo =
        shared_run().manifest.photos.iter().find(|p| !p.test).expect("one is trained on").name.as_str();
    let image = |run: &Path| run.join("transients").join(Path::new(photo).with_extension("png"));
    let paint = |run: &Path, share: u32| {
        let mask = Mask::read_png(&image(run)).expect("it opens");
        let (w, h) = (mask.width(), mask.height());
        Mask::from_fn(w, h, |x, _| x < w / share).write_png(&image(run)).expect("it is written");
    };
    let model = |run: &Path| std::fs::read(run.join("model.bin")).expect("a model");
    let steps = |run: &Path| -> u64 {
        let history = std::fs::read_to_string(run.join("history.jsonl")).expect("a history");
        let last: serde_json::Value =
            serde_json::from_str(history.lines().last().expect("a line")).expect("JSON");
        last["step"].as_u64().expect("a step")
    };
    let on = ["--continue-share", "0.25"];
    let all_reused = |run: &Path, flags: &[&str]| {
        let plans = plan(run, flags);
        assert!(plans.iter().all(|p| p.1 || p.0 == "report"), "{plans:?}");
    };
    // Nothing was put right: it stands as it is.
    all_reused(&run, &on);
    let (first, ended) = (model(&run), steps(&run));
    paint(&run, 2);
    for (stage, reused, why) in plan(&run, &on) {
        let independent = matches!(stage.as_str(), "sky" | "embed" | "masks");
        assert_eq!(reused, independent, "{stage}: {why}");
    }
    assert!(runs(&run, &[&["--explain"], &on[..]].concat()).contains(&format!("goes on from step {ended}")));
    let stdout = runs(&run, &on);
    assert!(stdout.contains(&format!("goes on from step {ended}")), "{stdout}");
    let (second, then) = (model(&run), steps(&run));
    assert!(second != first && then == ended + ended / 4, "{ended} steps, then {then}");
    all_reused(&run, &on);
    // The same from the same is the same.
    let (_kept_too, other) = start();
    paint(&other, 2);
    runs(&other, &on);
    assert!(model(&other) == second, "the same correction of the same training, the same scene");
    // Put right again, it goes on from there; taken back, the first scene is there again.
    paint(&run, 3);
    let stdout = runs(&run, &on);
    assert!(stdout.contains(&format!("goes on from step {then}")), "{stdout}");
    assert_eq!(steps(&run), then + ended / 4);
    all_reused(&run, &on);
    std::fs::remove_file(image(&run)).expect("it goes");
    runs(&run, &on);
    assert!(model(&run) == first, "without the correction the first scene is there again");
    // Under other settings there is nothing to go on from.
    paint(&run, 2);
    let stdout = runs(&run, &[&["--seed", "9"], &on[..]].concat());
    assert!(!stdout.contains("goes on from step"), "{stdout}");
}

#[test]
fn a_mask_that_covers_a_photo_or_does_not_fit_it_is_answered_by_name() {
    let dir = folder();
    let run = copied_run(&dir);
    let photo =
        shared_run().manifest.photos.iter().find(|p| !p.test).expect("one is trained on").name.as_str();
    let file = run.join("transients").join(Path::new(photo).with_extension("png"));
    let mask = Mask::read_png(&file).expect("it opens");
    Mask::full(mask.width(), mask.height()).write_png(&file).expect("it is written");
    let stdout = runs(&run, &[]);
    assert!(stdout.contains(photo) && stdout.contains("every pixel is masked out"), "{stdout}");

    Mask::empty(50, 50).write_png(&file).expect("it is written");
    let args = again(&run, &[]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let output = segwild(&args);
    let error = text(&output.stderr);
    assert!(output.status.code() != Some(0) && error.contains(photo) && error.contains("50 x 50"), "{error}");
    let nowhere = again(&run, &["--transient-masks", "/nowhere/at/all"]);
    refuses(&nowhere.iter().map(String::as_str).collect::<Vec<_>>(), 2, &["no such folder"]);
}

#[test]
fn transients_are_found_and_scored_against_the_truth() {
    use segwild_synthetic::{LightVariation, SyntheticOptions, generate};
    let dir = folder();
    let shared_run = dir.path().join("crowd");
    let options = SyntheticOptions {
        seed: 5,
        train: 20,
        test: 2,
        long_side: 128,
        points: 1500,
        occlusion: 0.15,
        photo_light: LightVariation::None,
        ..SyntheticOptions::small()
    };
    generate(&options).and_then(|s| s.write(&shared_run)).expect("a scene with a crowd");
    let run = show(&dir.path().join("run"));
    works(&[
        "run",
        &show(&shared_run),
        "--out",
        &run,
        "--size",
        "128",
        "--steps",
        "500",
        "--refine-steps",
        "4",
        "--prompt-budget",
        "24",
    ]);
    let truth = show(&shared_run.join("truth/transient"));
    let scores: serde_json::Value =
        serde_json::from_str(&works(&["eval", &run, "--transient-truth", &truth, "--json"])).expect("scores");
    let iou = scores["pooled_iou"].as_f64().expect("a number");
    let wrong = scores["false_share"].as_f64().expect("a number");
    assert!(iou > 0.45 && wrong < 0.06, "IoU {iou}, {wrong} of the photos wrongly left out");
}

#[test]
fn a_damaged_machine_made_mask_is_put_aside_and_made_again() {
    let dir = folder();
    let run = copied_run(&dir);
    let trained: Vec<&str> =
        shared_run().manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.as_str()).collect();
    let image = |photo: &str| run.join("transients").join(Path::new(photo).with_extension("png"));
    let model = std::fs::read(run.join("model.bin")).expect("a model");
    let whole: Vec<Vec<u8>> = trained.iter().map(|p| std::fs::read(image(p)).expect("an image")).collect();
    let mut flipped = whole[1].clone();
    flipped[whole[1].len() / 2] ^= 0x10;
    for (photo, bytes) in
        [(trained[0], &whole[0][..whole[0].len() / 2]), (trained[1], &flipped[..]), (trained[2], &[][..])]
    {
        std::fs::write(image(photo), bytes).expect("it is written");
    }
    // The list of what this program made is lost as well: each mask says it of itself.
    std::fs::write(run.join("transients/made.json"), "{").expect("it is written");
    let stdout = runs(&run, &[]);
    assert!(stdout.contains("is put aside as") && !stdout.contains("put right by hand"), "{stdout}");
    for (photo, bytes) in trained.iter().zip(&whole) {
        assert_eq!(&std::fs::read(image(photo)).expect("it is there again"), bytes, "{photo}");
    }
    let aside = image(trained[0]).with_extension("png.damaged");
    assert_eq!(std::fs::read(aside).expect("it is kept"), &whole[0][..whole[0].len() / 2]);
    assert_eq!(std::fs::read(run.join("model.bin")).expect("a model"), model, "nothing was trained again");
}

#[test]
fn one_bad_or_turned_true_mask_is_named_and_the_others_are_scored() {
    let dir = folder();
    let run = copied_run(&dir);
    let truth = dir.path().join("truth");
    std::fs::create_dir(&truth).expect("a folder");
    let eval = |truth: &Path| segwild(&["eval", &show(&run), "--transient-truth", &show(truth)]);
    let missing = eval(&dir.path().join("nowhere"));
    assert_eq!(
        (missing.status.code(), eval(&truth).status.code()),
        (Some(3), Some(3)),
        "both are the user's"
    );
    let trained: Vec<&str> =
        shared_run().manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.as_str()).take(3).collect();
    let names: Vec<_> = trained.iter().map(|photo| Path::new(photo).with_extension("png")).collect();
    for name in &names {
        std::fs::copy(run.join("transients").join(name), truth.join(name)).expect("a copy");
    }
    std::fs::write(truth.join(&names[0]), b"no image").expect("it is written");
    let mask = Mask::read_png(&truth.join(&names[1])).expect("it opens");
    assert_ne!(mask.width(), mask.height(), "a quarter turn changes its shape");
    let turned = Mask::from_fn(mask.height(), mask.width(), |x, y| x > y);
    turned.write_png(&truth.join(&names[1])).expect("it is written");
    let output = eval(&truth);
    let stdout = text(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{stdout}");
    assert_eq!(stdout.matches("does not count").count(), 2, "{stdout}");
    assert!(stdout.contains("which does not fit the photo's"), "{stdout}");
    assert!(text(&output.stdout).contains(trained[2]), "{}", text(&output.stdout));
}
