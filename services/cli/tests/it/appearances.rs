//! Appearances at the command line: on views, on one object, between photos, in files.

use crate::common::{QUICK, clearest, copied_run, folder, json, refuses, scene, shared_run, show, works};
use segwild_scene::{Image, ply};
use std::path::Path;

/// Renders and reads the images back, in order.
fn draw(run: &str, out: &Path, flags: &[&str]) -> Vec<Image> {
    let _ = std::fs::remove_dir_all(out); // there from the image before
    let out = show(out);
    let stdout = works(&[&["render", run, "--out", &out], flags].concat());
    stdout.lines().map(|file| Image::read(Path::new(file)).expect("an image")).collect()
}

fn apart(a: &Image, b: &Image) -> f32 {
    let sum: f32 = a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).sum();
    sum / a.data.len() as f32
}

#[test]
fn a_view_is_rendered_with_other_photos_appearances_interpolated_and_in_any_strength() {
    let run = show(&shared_run().run);
    let dir = folder();
    let out = dir.path().join("renders");
    let trained: Vec<&str> =
        shared_run().manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.as_str()).collect();
    let view = trained[0];
    let one = |flags: &[&str]| draw(&run, &out, &[&["--photo", view], flags].concat()).remove(0);
    let own = one(&[]);
    assert_eq!(one(&["--appearance", view]), own);
    // The photo whose look is furthest from this one's.
    let far = |name: &&&str| (apart(&one(&["--appearance", name]), &own) * 1e6) as u64;
    let other = *trained[1..].iter().max_by_key(far).expect("there are several");
    let others = one(&["--appearance", other]);
    assert!(apart(&others, &own) > 0.01, "{}", apart(&others, &own));
    let half = one(&["--appearance", view, "--appearance", other, "--interpolate", "0.5"]);
    let (there, back) = (apart(&half, &own), apart(&half, &others));
    assert!((there - back).abs() < 0.1 * (there + back), "half way: {there} from one, {back} from the other");
    // Eight bits hold a walk over the frames to be the same, and its ends the appearances.
    let walk =
        draw(&run, &out, &["--photo", view, "--appearance", view, "--appearance", other, "--frames", "3"]);
    assert_eq!((&walk[0], &walk[1], &walk[2]), (&own, &half, &others));
    let none = one(&["--appearance", "none"]);
    assert_eq!(one(&["--appearance", other, "--strength", "0"]), none);
    let twice = one(&["--appearance", other, "--strength", "2"]);
    assert!(apart(&twice, &none) > 1.3 * apart(&others, &none));
    // Along a path the appearance goes from that of the first photo to that of the last.
    let path = draw(&run, &out, &["--photo", view, "--photo", other, "--frames", "2"]);
    let ends = [own, draw(&run, &out, &["--photo", other]).remove(0)];
    // The path has the first photo's frame, so that its last image is like the photo's and not the same.
    assert!(
        path[0].pixels() == ends[0].pixels() && apart(&path[0], &ends[0]) < 0.06,
        "{}",
        apart(&path[0], &ends[0])
    );

    let out = show(&out);
    let wrong = |flags: &[&str], words: &[&str]| {
        refuses(&[&["render", &run, "--photo", view, "--out", &out], flags].concat(), 2, words);
    };
    wrong(&["--mode", "only"], &["--selection <NAME>"]); // was once rendered whole, without a message
    wrong(&["--appearance", "nobody.jpg"], &["no photo `nobody.jpg`"]);
    wrong(&["--appearance", view, "--appearance", other], &["--frames", "--interpolate"]);
    wrong(&["--appearance", view, "--interpolate", "0.5"], &["two appearances"]);
    wrong(&["--appearance", view, "--strength", "3"], &["0 to 2"]);
    wrong(&["--object-appearance", other], &["--selection"]);
    wrong(&["--frames", "4"], &["--photo twice"]);
    let held_out = &shared_run().manifest.photos.iter().find(|p| p.test).expect("one is held out").name;
    wrong(&["--appearance", held_out], &["no appearance", held_out]);
}

#[test]
fn one_object_has_its_own_appearance_on_screen_and_in_files() {
    let dir = folder();
    let path = copied_run(&dir);
    let (run, out) = (show(&path), dir.path().join("renders"));
    let manifest = &shared_run().manifest;
    let (_, click) = clearest();
    let view = click.photo.as_str();
    let other = manifest.photos.iter().find(|p| !p.test && p.name != view).expect("another");
    let other = other.name.as_str();
    let at = format!("{},{}", click.x, click.y);
    // What the photo itself shows there: a hall, whatever the scene tree means.
    let segment = ["segment", &run, "--photo", view, "--positive", &at, "--first-answer", "photo"];
    works(&[&segment[..], &["--name", "thing"]].concat());
    let one = |flags: &[&str]| {
        draw(&run, &out, &[&["--photo", view, "--selection", "thing"], flags].concat()).remove(0)
    };
    let (plain, mixed) = (one(&["--mode", "scene"]), one(&["--object-appearance", other]));
    let all = one(&["--mode", "scene", "--appearance", other]);
    let mask = segwild_scene::Mask::read_png(
        &path.join("selections/thing/masks").join(Path::new(view).with_extension("png")),
    )
    .expect("the object's mask");
    let mask = mask.resized(mixed.width as u32, mixed.height as u32);
    let (inside, outside) = (mask.eroded(3.0), mask.not().eroded(3.0));
    let mean = |a: &Image, b: &Image, over: &segwild_scene::Mask| {
        let sum: f32 = over
            .pixels()
            .map(|(x, y)| (a.at(1, x as usize, y as usize) - b.at(1, x as usize, y as usize)).abs())
            .sum();
        sum / over.count().max(1) as f32
    };
    assert!(inside.count() > 50 && outside.count() > 50);
    let (object_off, rest_off) = (mean(&mixed, &all, &inside), mean(&mixed, &plain, &outside));
    assert!(object_off < 0.02, "the object is as in the other's look, {object_off} off");
    assert!(rest_off < 0.02, "the rest is as it was, {rest_off} off");
    assert!(mean(&mixed, &plain, &inside) > object_off);

    // The same in files that know nothing of looks.
    let splats = |flags: &[&str], name: &str| {
        let file = dir.path().join(name);
        works(&[&["bake", &run, "--out", &show(&file)], flags].concat());
        ply::read(&file).expect("it opens")
    };
    let object = ply::read(&path.join("selections/thing/object.ply")).expect("it opens");
    assert_eq!(splats(&["--selection", "thing"], "own.ply"), object, "both in the scene's own appearance");
    let relit = splats(&["--selection", "thing", "--appearance", other], "relit.ply");
    assert!(relit.means == object.means && relit.sh != object.sh);
    works(&[&segment[..], &["--name", "lit", "--object-appearance", other]].concat());
    assert_eq!(ply::read(&path.join("selections/lit/object.ply")).expect("it opens"), relit);
    let whole = splats(&["--selection", "thing", "--object-appearance", other], "whole.ply");
    let rest = splats(&["--selection", "thing", "--mode", "without"], "rest.ply");
    // What no photo saw is gone with the object.
    assert!(rest.len() <= whole.len() - object.len() && rest.len() > (whole.len() - object.len()) / 2);
    let stride = whole.sh_stride();
    let has = |of: &segwild_scene::Splats| {
        let rows: std::collections::BTreeSet<Vec<u32>> = (0..of.len())
            .map(|i| {
                of.means[i].iter().chain(&of.sh[i * stride..(i + 1) * stride]).map(|v| v.to_bits()).collect()
            })
            .collect();
        rows
    };
    let rows = has(&whole);
    assert!(has(&relit).is_subset(&rows) && has(&rest).is_subset(&rows));
    assert_eq!(splats(&[], "scene.ply"), ply::read(&path.join("scene.ply")).expect("it opens"));
    refuses(&["bake", &run, "--mode", "only"], 2, &["--selection"]);
    refuses(&["bake", &run, "--appearance", view, "--appearance", other], 2, &["--interpolate"]);
    refuses(
        &[&segment[..], &["--name", "x", "--object-appearance", "nobody.jpg"]].concat(),
        2,
        &["no photo `nobody.jpg`"],
    );
    assert!(
        std::fs::read_to_string(path.join("report.html")).expect("a report").contains("<h2>Appearances</h2>")
    );
}

#[test]
fn auto_says_what_it_chose_and_why_and_shares_its_work_with_the_model_by_name() {
    let dir = folder();
    let run = show(&dir.path().join("run"));
    let with = |model: &str, flags: &[&str]| {
        // All but the appearance model, which comes last.
        let quick = &QUICK[..QUICK.len() - 2];
        works(
            &[&["run", &show(scene()), "--out", &run, "--appearance-model", model][..], quick, flags]
                .concat(),
        )
    };
    let stdout = with("auto", &["--json"]);
    let choice = json(&std::fs::read(dir.path().join("run/appearance_choice.json")).expect("the choice"));
    let model = choice["appearance"].as_str().expect("an appearance model").to_owned();
    let why = choice["why"].as_str().expect("a reason");
    assert!(stdout.contains(why), "the run says why: {why}");
    assert!(why.starts_with(&model) && why.contains("points") && why.contains("held out"), "{why}");
    let report = std::fs::read_to_string(dir.path().join("run/report.html")).expect("a report");
    assert!(report.contains(&format!("chosen {model}")));
    // Decided once, and the same scene as by name.
    let reused = |model: &str| {
        let plan = with(model, &["--explain", "--json"]);
        assert!(plan.contains("\"geometry\""), "{plan}");
        plan.lines().filter(|line| !line.contains("\"report\"")).all(|line| line.contains("\"reused\""))
    };
    assert!(reused("auto"), "{}", with("auto", &["--explain"]));
    assert!(reused(&model), "{}", with(&model, &["--explain"]));
}

#[test]
fn a_budget_is_decided_once_reported_with_its_evidence_and_undone_by_name() {
    let dir = folder();
    let run = show(&dir.path().join("run"));
    let with = |flags: &[&str]| {
        let steps = ["--steps", "2000", "--appearance-model", "affine", "--until", "geometry"];
        works(&[&["run", &show(scene()), "--out", &run][..], &QUICK[..2], &steps, flags].concat())
    };
    let stdout = with(&["--budget", "auto", "--json"]);
    let choice = json(&std::fs::read(dir.path().join("run/budget.json")).expect("the choice"));
    let why = choice["why"].as_str().expect("a reason");
    assert!(stdout.contains(why) && why.contains("held out") && why.contains("SSIM"), "{why}");
    let steps = choice["steps"].as_u64().expect("steps");
    let trained =
        |stdout: &str| stdout.lines().rfind(|line| line.contains("\"geometry\"")).map(str::to_owned);
    assert!(steps <= 2000 && trained(&stdout).is_some(), "{stdout}");
    let history = std::fs::read_to_string(dir.path().join("run/history.jsonl")).expect("a history");
    let last = json(history.lines().last().expect("a line").as_bytes());
    assert_eq!(last["step"].as_u64(), Some(steps), "as many steps as were decided");
    // Remembered, and not decided again; `fixed` is what the settings say.
    let plan = with(&["--explain", "--json"]);
    assert!(plan.lines().any(|line| line.contains("\"geometry\"") && line.contains("\"reused\"")), "{plan}");
    let plan = with(&["--budget", "fixed", "--explain", "--json"]);
    let reused = plan.lines().any(|line| line.contains("\"geometry\"") && line.contains("\"reused\""));
    assert_eq!(reused, steps == 2000, "{plan}");
}

#[test]
fn a_time_is_decided_once_reported_and_refused_where_it_does_not_suffice() {
    let dir = folder();
    let (photos, run) = (show(scene()), show(&dir.path().join("run")));
    let open: Vec<&str> = QUICK
        .chunks(2)
        .filter(|flag| !["--splats", "--steps"].contains(&flag[0]))
        .flatten()
        .copied()
        .collect();
    let with = |flags: &[&'static str]| {
        [&["run", &photos, "--out", &run, "--until", "geometry"][..], &open, flags].concat()
    };
    refuses(&with(&["--time", "10"]), 2, &["`10` does not fit `time`", "90s, 10m, 2h or 1h30m"]);
    let both = ["--time", "10m", "--steps", "60", "--splats", "500"];
    refuses(&with(&both), 2, &["--steps 60 and --splats 500 are both set"]);
    let little = ["--time", "1s", "--steps", "4000"];
    refuses(&with(&little), 2, &["a time of 1s does not suffice", "4000 steps", "or more"]);
    let stdout = works(&with(&["--time", "10m", "--steps", "60", "--json"]));
    let choice = json(&std::fs::read(dir.path().join("run/time.json")).expect("the choice"));
    let why = choice["why"].as_str().expect("a sentence");
    assert!(stdout.contains(why), "the run says what it buys: {why}");
    assert!(why.starts_with("10m buy 60 steps (as set) and ") && why.contains(" a step here"), "{why}");
    assert_eq!((choice["steps"].as_u64(), choice["splats"].as_u64()), (Some(60), Some(0)));
    // Remembered with the run, and not decided again.
    let plan = works(&with(&["--explain", "--json"]));
    assert!(plan.lines().any(|line| line.contains("\"geometry\"") && line.contains("\"reused\"")), "{plan}");
    assert!(plan.contains(why) && plan.contains("decided when the run started"), "{plan}");
    // Another time is measured, and nothing is kept of it.
    let plan = works(&with(&["--time", "20m", "--explain"]));
    assert!(plan.contains("20m buy 60 steps (as set)") && plan.contains("measured now"), "{plan}");
}

#[test]
fn splats_are_written_in_the_format_that_the_ending_names() {
    let run = show(&shared_run().run);
    let dir = folder();
    let baked = |name: &str| {
        let file = dir.path().join(name);
        works(&["bake", &run, "--out", &show(&file)]);
        std::fs::read(&file).expect("a file")
    };
    let (ply, spz, glb) = (baked("a.ply"), baked("a.spz"), baked("a.GLB"));
    assert!(ply.starts_with(b"ply\n") && glb.starts_with(b"glTF"));
    assert!(
        spz.starts_with(&[0x1f, 0x8b]) && 4 * spz.len() < ply.len(),
        "{} bytes of {}",
        spz.len(),
        ply.len()
    );
    let document = String::from_utf8_lossy(&glb);
    assert!(document.contains("KHR_gaussian_splatting:ROTATION") && document.contains("SplatRenderMode"));
    let other = show(&dir.path().join("a.obj"));
    refuses(&["bake", &run, "--out", &other], 2, &["a.obj", ".ply, .spz, .glb"]);
    assert!(!dir.path().join("a.obj").exists());
}

#[test]
fn a_photo_that_is_not_in_the_scene_gives_it_its_appearance() {
    let (scene, run) = (scene(), show(&shared_run().run));
    let dir = folder();
    let out = dir.path().join("renders");
    let photos: Vec<&str> =
        shared_run().manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.as_str()).collect();
    // The channel means tell lights that are colour matrices apart.
    let means = |flags: &[&str]| {
        let image = draw(&run, &out, &[&["--photo", photos[0]], flags].concat()).remove(0);
        [0, 1, 2].map(|c| image.plane(c).iter().sum::<f32>() / image.pixels() as f32)
    };
    let apart = |a: [f32; 3], b: [f32; 3]| (0..3).map(|c| (a[c] - b[c]).abs()).sum::<f32>();
    let own = means(&["--appearance", "none"]);
    let (mut fitted_off, mut own_off) = (0.0, 0.0);
    for (k, photo) in photos.iter().enumerate() {
        // A file of the caller's own, which the run does not know.
        let file = dir.path().join(format!("holiday-{k}.png"));
        std::fs::copy(scene.join("images").join(photo), &file).expect("it is copied");
        let trained = means(&["--appearance", photo]);
        fitted_off += apart(means(&["--appearance-from", &show(&file)]), trained);
        own_off += apart(own, trained);
    }
    assert!(fitted_off < 0.75 * own_off, "{fitted_off} off those trained, the scene's own {own_off}");
    let file = show(&dir.path().join("holiday-1.png"));
    let weak = means(&["--appearance-from", &file, "--strength", "0"]);
    assert!(apart(weak, own) < 0.01, "no strength is the scene's own appearance");
    let baked = dir.path().join("holiday.ply");
    works(&["bake", &run, "--appearance-from", &file, "--out", &show(&baked)]);
    assert_ne!(
        ply::read(&baked).expect("it opens").sh,
        ply::read(&shared_run().run.join("scene.ply")).expect("it opens").sh
    );
    let render = ["render", &run, "--photo", photos[0]];
    refuses(&[&render[..], &["--appearance-from", "nowhere.jpg"]].concat(), 3, &["nowhere.jpg"]);
    let text = dir.path().join("text.jpg");
    std::fs::write(&text, "no photo").expect("it is written");
    refuses(&[&render[..], &["--appearance-from", &show(&text)]].concat(), 3, &["text.jpg"]);
}

#[test]
fn splats_are_written_where_the_runs_accelerator_is_not() {
    let dir = folder();
    let run = copied_run(&dir);
    let settings = run.join("segwild.toml");
    let text = std::fs::read_to_string(&settings).expect("its settings");
    let elsewhere = |line: &str| match line.split_once(" = ").map(|(name, _)| name) {
        Some("engine") => "engine = \"gpu\"\n".to_owned(),
        Some("adapter") => "adapter = \"nonesuch\"\n".to_owned(),
        _ => format!("{line}\n"),
    };
    let elsewhere: String = text.lines().map(elsewhere).collect();
    assert!(elsewhere.contains("engine = \"gpu\"\n") && elsewhere.contains("\"nonesuch\""));
    std::fs::write(&settings, elsewhere).expect("it is written");
    let file = dir.path().join("scene.ply");
    works(&["bake", &show(&run), "--out", &show(&file)]);
    assert!(file.is_file());
}
