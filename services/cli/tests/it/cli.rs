//! The program as a person meets it: whole runs on a small synthetic scene, and every kind of bad input, with the
//! sentence and the exit code that were promised.

use crate::common::*;
use std::path::Path;
use std::process::Command;

#[test]
fn a_run_leaves_what_other_tools_open() {
    let shared_run = shared_run();
    for file in [
        "segwild.toml",
        "scene.json",
        "cameras.json",
        "scene.ply",
        "model.bin",
        "features.bin",
        "report.html",
        "evaluation.json",
    ] {
        assert!(shared_run.run.join(file).is_file(), "{file} is missing");
    }
    let splats = segwild_scene::ply::read(&shared_run.run.join("scene.ply")).expect("the scene opens");
    assert!(splats.len() > 100);
    let report = std::fs::read_to_string(shared_run.run.join("report.html")).expect("a report");
    assert!(
        report.contains("data:image/jpeg;base64,") && !report.contains("src=\"http"),
        "one self-contained file"
    );
    let held_out = shared_run.manifest.photos.iter().find(|p| p.test).expect("one is held out");
    let render = shared_run.run.join("held_out").join(Path::new(&held_out.name).with_extension("png"));
    assert!(
        segwild_scene::Image::read(&render).is_ok_and(|image| image.width.max(image.height) == 96),
        "{render:?}"
    );
    // What was left out of every photo that was trained on stands beside its figure.
    let trained = shared_run.manifest.photos.iter().filter(|p| !p.test).count();
    let (_, of_photos) = report.split_once("<h2>Photos trained on</h2>").expect("the photos' table");
    assert!(of_photos.contains(&format!("<summary>{trained} photos")), "{trained} photos");
    assert!(report.contains("over all pixels but the sky,") && report.contains("taken for transients"));
    let stdout = works(&["eval", &show(&shared_run.run)]);
    assert!(stdout.contains("dB") && stdout.contains("left half"), "{stdout}");
    let status = works(&["status", &show(&shared_run.run), "--json"]);
    let status: serde_json::Value = serde_json::from_str(&status).expect("JSON");
    assert_eq!(status["running"], false);
    assert!(status["stages"].as_array().expect("stages").iter().all(|s| s["state"] == "done"), "{status}");
}

#[test]
fn a_second_run_does_no_work_twice() {
    let dir = folder();
    let run = copied_run(&dir);
    let scene = show(&shared_run().scene);
    let model = std::fs::read(run.join("model.bin")).expect("a model");
    let stdout = works(&["run", &scene, "--out", &show(&run), "--json"]);
    let summary = stdout.lines().find(|l| l.contains("\"summary\"")).expect("a summary line");
    let summary: serde_json::Value = serde_json::from_str(summary).expect("JSON");
    assert_eq!(summary["summary"]["made"], 0, "{summary}");
    assert!(summary["summary"]["cached"].as_u64() > Some(8), "{summary}");
    assert_eq!(std::fs::read(run.join("model.bin")).expect("a model"), model);
    // A setting of the last stages leaves the geometry alone.
    let stdout = works(&["run", &scene, "--out", &show(&run), "--json", "--channels", "16"]);
    let skipped = stdout.lines().filter(|l| l.contains("stage_skipped")).collect::<Vec<_>>().join("\n");
    assert!(skipped.contains("geometry") && !skipped.contains("features"), "{stdout}");
    assert_eq!(std::fs::read(run.join("model.bin")).expect("a model"), model);
}

#[test]
fn a_killed_run_ends_in_the_same_bytes() {
    let dir = folder();
    let run = show(&dir.path().join("run"));
    let scene = show(&shared_run().scene);
    let args = [&["run", &scene, "--out", &run, "--checkpoint-every", "1"][..], &QUICK].concat();
    let Guarded(child) = &mut in_background(&args);
    // Killed once the training has begun, wherever it is then.
    let history = dir.path().join("run/history.jsonl");
    while child.try_wait().expect("a child").is_none() {
        if std::fs::read_to_string(&history).is_ok_and(|t| !t.is_empty()) {
            child.kill().expect("it can be killed");
        }
        std::thread::yield_now();
    }
    works(&args);
    for file in ["model.bin", "features.bin"] {
        let bytes = |run: &Path| std::fs::read(run.join(file)).expect("it is there");
        assert!(bytes(Path::new(&run)) == bytes(&shared_run().run), "{file} depends on the interruption");
    }
}

#[test]
fn clicks_become_an_object_that_can_be_rendered_scored_and_replayed() {
    let dir = folder();
    let path = copied_run(&dir);
    let run = show(&path);
    let manifest = &shared_run().manifest;
    let (name, click) = clearest();
    let at = format!("{},{}", click.x, click.y);
    // That of the run bears the name of the folder it was copied from.
    let report = path.join("report.html");
    std::fs::remove_file(&report).expect("it goes");
    works(&["segment", &run, "--photo", &click.photo, "--positive", &at, "--name", "thing"]);
    let thing = path.join("selections/thing");
    let object = segwild_scene::ply::read(&thing.join("object.ply")).expect("the object opens");
    let labels = segwild_scene::ply::read_extra(&thing.join("labels.ply"), "label").expect("it opens");
    let labels = labels.expect("it has labels");
    assert_eq!(labels.iter().filter(|&&l| l == 1).count(), object.len());
    assert!(labels.len() > object.len());
    assert_eq!(std::fs::read_dir(thing.join("masks")).expect("masks").count(), 10, "one mask per photo");

    // The file holds how they were used as well as the clicks.
    let other = ["--tau", "0.3", "--propagate", "0", "--spikes", "off", "--evidence-mode", "centre"];
    let click_again = ["segment", &run, "--photo", &click.photo, "--positive", &at, "--name", "other"];
    works(&[&click_again[..], &other].concat());
    let read = |name: &str| {
        let file = path.join("selections").join(name).join("object.ply");
        segwild_scene::ply::read(&file).expect("it opens")
    };
    assert!(read("other") != object, "other settings select other splats");
    for (name, object) in [("thing", object), ("other", read("other"))] {
        let prompts = show(&path.join("selections").join(name).join("prompts.json"));
        works(&["segment", &run, "--prompts", &prompts, "--name", "again"]);
        assert!(read("again") == object, "{name}: the same prompts select the same splats");
        refuses(
            &["segment", &run, "--prompts", &prompts, "--photo", "a", "--positive", "1,1"],
            2,
            &["--prompts"],
        );
    }
    // A selection is added to the report, which says what it would say if it were written again.
    let added = std::fs::read_to_string(&report).expect("a report");
    assert!(["thing", "other", "again"].iter().all(|name| added.contains(&format!("Object: {name}<"))));
    std::fs::remove_file(&report).expect("it goes");
    let prompts = show(&path.join("selections/other/prompts.json"));
    works(&["segment", &run, "--prompts", &prompts, "--name", "again"]);
    assert!(std::fs::read_to_string(&report).expect("a report") == added);

    let truth = show(&shared_run().scene.join("truth").join(name));
    assert!(works(&["eval", &run, "--truth", &truth, "--selection", "thing"]).contains("mean"));
    // One true mask that cannot be read costs that photo alone.
    let copy = dir.path().join("truth");
    std::fs::create_dir(&copy).expect("a folder");
    for (k, file) in std::fs::read_dir(&truth).expect("masks").enumerate() {
        let file = file.expect("a mask");
        let to = copy.join(file.file_name());
        if k == 0 { std::fs::write(to, b"no PNG").map(|()| 0) } else { std::fs::copy(file.path(), to) }
            .expect("a copy");
    }
    let output = segwild(&["eval", &run, "--truth", &show(&copy), "--selection", "thing"]);
    assert!(output.status.success() && text(&output.stderr).contains("this photo does not count"));
    let out = show(&dir.path().join("renders"));
    let only =
        ["render", &run, "--photo", &click.photo, "--selection", "thing", "--mode", "only", "--out", &out];
    let image = segwild_scene::Image::read(Path::new(works(&only).trim())).expect("an image");
    assert_eq!(image.width.max(image.height), 96);
    let photos: Vec<&str> = manifest.photos.iter().take(2).map(|p| p.name.as_str()).collect();
    let path = ["render", &run, "--photo", photos[0], "--photo", photos[1], "--frames", "3", "--out", &out];
    assert_eq!(works(&path).lines().count(), 3);
    for what in ["depth", "alpha", "features"] {
        works(&[
            "render",
            &run,
            "--photo",
            photos[0],
            "--what",
            what,
            "--appearance",
            photos[1],
            "--out",
            &out,
        ]);
    }
}

#[test]
fn bad_clicks_are_answered_in_words() {
    let run = show(&shared_run().run);
    let photo = shared_run().manifest.photos[0].name.as_str();
    refuses(
        &["segment", &run, "--photo", "nobody.png", "--positive", "1,1"],
        2,
        &["no photo `nobody.png`", "10 photos"],
    );
    refuses(&["segment", &run, "--photo", photo, "--positive", "1;1"], 2, &["--positive 1;1", "2 numbers"]);
    refuses(&["segment", &run, "--photo", photo, "--positive", "nan,1"], 2, &["2 numbers"]);
    refuses(&["segment", &run, "--positive", "1,1"], 2, &["before --photo"]);
    refuses(&["segment", &run, "--photo", photo], 2, &["nothing is prompted"]);
    refuses(&["segment", &run, "--photo", photo, "--positive", "9999,3"], 2, &["outside", photo]);
    refuses(
        &["segment", &run, "--photo", photo, "--positive", "1,1", "--name", "../x"],
        2,
        &["cannot name a selection"],
    );
    refuses(&["render", &run, "--selection", "none-such"], 2, &["no selection named `none-such`"]);
    refuses(&["render", &run, "--frames", "4294967295"], 2, &["--frames", "100000"]);
    refuses(&["render", &run, "--out", "no-such/turn.GIF"], 2, &["turn.GIF", "a video is .mp4"]);
    let odd = format!("two\nlines{}", "x".repeat(400));
    let output = segwild(&["render", &run, "--selection", &odd]);
    let stdout = text(&output.stderr);
    assert_eq!((output.status.code(), stdout.trim_end().lines().count()), (Some(2), 1), "{stdout}");
    assert!(stdout.contains("two\\nlines") && stdout.len() < 300, "{stdout}");
    refuses(&["segment", &run, "--photo", photo, "--negative", "3,3"], 2, &["where it is"]);
    refuses(
        &["segment", &run, "--photo", photo, "--positive", "3,3", "--negative", "3,3"],
        2,
        &["inside and outside"],
    );
    refuses(
        &["segment", &run, "--photo", photo, "--positive", "3,3", "--granularity", "nan"],
        2,
        &["0 to 1"],
    );
    refuses(&["eval", &run, "--truth", "/nowhere"], 2, &["no selection named `object`"]);
    // With --json, errors are JSON too.
    let output = segwild(&["eval", &run, "--truth", "/nowhere", "--json"]);
    let stderr = json(&output.stdout);
    assert_eq!(stderr["exit_code"], 2);
    assert!(stderr["error"].as_str().is_some_and(|e| e.contains("no selection")), "{stderr}");
}

#[test]
fn bad_scenes_are_answered_in_words() {
    let dir = folder();
    let out = show(&dir.path().join("out"));
    refuses(&["run", "/nowhere/at/all", "--out", &out], 3, &["/nowhere/at/all"]);
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).expect("a folder");
    let words = ["is empty", "looked for", "COLMAP", "transforms.json"];
    refuses(&["run", &show(&empty), "--out", &out], 3, &words);
    let images = shared_run().scene.join("images");
    let mut photos = std::fs::read_dir(images).expect("a folder").flatten();
    let photo = photos.next().expect("a photo").path();
    refuses(&["run", &show(&photo), "--out", &out], 3, &["is one photo", "give the folder"]);

    let cut = dir.path().join("cut");
    copy_folder(&shared_run().scene, &cut);
    let images = cut.join("sparse/0/images.bin");
    let bytes = std::fs::read(&images).expect("a file");
    std::fs::write(&images, &bytes[..bytes.len() / 2]).expect("it is written");
    refuses(&["run", &show(&cut), "--out", &out], 3, &["images.bin", "cut short", "byte"]);

    let none = dir.path().join("none");
    copy_folder(&shared_run().scene, &none);
    std::fs::remove_dir_all(none.join("images")).expect("it goes");
    std::fs::create_dir(none.join("images")).expect("a folder");
    refuses(&["run", &show(&none), "--out", &out], 3, &["nothing usable"]);
}

#[test]
fn one_bad_photo_is_skipped_by_name_and_the_rest_goes_on() {
    let shared_run = shared_run();
    let dir = folder();
    let scene = dir.path().join("scene");
    copy_folder(&shared_run.scene, &scene);
    let names: Vec<&str> =
        shared_run.manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.as_str()).collect();
    std::fs::remove_file(scene.join("images").join(names[0])).expect("it goes");
    std::fs::write(scene.join("images").join(names[1]), b"this is no image").expect("it is written");
    let out = show(&dir.path().join("out"));
    let stdout = works(&[&["run", &show(&scene), "--out", &out, "--until", "geometry"][..], &QUICK].concat());
    for name in &names[..2] {
        assert!(
            stdout.lines().any(|l| l.starts_with("photo") && l.contains(name) && l.contains("left out")),
            "{name} is not named: {stdout}"
        );
    }
}

#[test]
fn bad_settings_are_answered_in_words() {
    let scene = show(&shared_run().scene);
    let dir = folder();
    let out = show(&dir.path().join("out"));
    refuses(&["run", &scene, "--out", &out, "--steps", "many"], 2, &["`many` does not fit `steps`"]);
    refuses(&["run", &scene, "--out", &out, "--preset", "fast"], 2, &["draft", "standard", "best"]);
    let file = dir.path().join("my.toml");
    std::fs::write(&file, "[train]\nstpes = 3\n").expect("it is written");
    refuses(&["run", &scene, "--out", &out, "--config", &show(&file)], 2, &["my.toml", "stpes"]);
    refuses(&["run", &scene, "--out", &out, "--models", "/nowhere"], 3, &["/nowhere"]);
    // A program reads the same in JSON.
    for (args, word) in [(&["run", "--sise", "3", "--json"][..], "--sise"), (&["run", "--json"], "<SCENE>")] {
        let refused = segwild(args);
        let printed = json(&refused.stdout);
        let sentence = printed["error"].as_str().unwrap_or_default();
        assert!(refused.status.code() == Some(2) && printed["exit_code"] == 2, "{printed}");
        assert!(sentence.contains(word) && !sentence.contains("Usage"), "{printed}");
    }
}

#[test]
fn a_folder_that_is_no_run_is_reported_as_none() {
    let dir = folder();
    for command in ["segment", "render", "eval", "status"] {
        refuses(
            &[command, &show(dir.path()), "--photo", "a"][..if command == "segment" { 4 } else { 2 }],
            6,
            &["no run folder", "segwild run"],
        );
    }
}

#[test]
fn a_damaged_model_is_named() {
    let dir = folder();
    let run = copied_run(&dir);
    let bytes = std::fs::read(run.join("model.bin")).expect("a model");
    std::fs::write(run.join("model.bin"), &bytes[..bytes.len() - 9]).expect("it is written");
    refuses(&["render", &show(&run)], 6, &["model.bin", "run again"]);
}

#[test]
fn the_pages_of_settings_commands_and_requests_are_up_to_date() {
    let pages = [
        (&["--settings", "user"][..], "settings.md"),
        (&["--settings", "expert"], "expert-settings.md"),
        (&["--commands"], "cli.md"),
        (&["--openapi"], "openapi.json"),
    ];
    for (page, file) in pages {
        let printed = works(&[&["doctor"], page].concat());
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/reference").join(file);
        let kept = std::fs::read_to_string(&file).expect("the page");
        let command = format!("segwild doctor {} > {}", page.join(" "), file.display());
        assert_eq!(printed, kept, "{} is out of date: `{command}`", file.display());
    }
}

#[test]
fn flags_and_values_of_an_earlier_version_are_refused_with_the_present_ones() {
    for (args, now) in [
        (&["run", "scene", "--look", "embed"][..], "--appearance-model"),
        (&["run", "scene", "--strangers", "masks"], "--transient-masks"),
        (&["segment", "run", "--photo", "a", "--in", "1,1"], "--positive"),
        (&["segment", "run", "--photo", "a", "--out", "1,1"], "--negative"),
        (&["render", "run", "--look", "a"], "--appearance"),
        (&["bake", "run", "--between", "0.5"], "--interpolate"),
        (&["eval", "run", "--strangers", "masks"], "--transient-truth"),
        (&["run", "scene", "--listen", "127.0.0.1:0"], "--metrics-listen"),
        (&["serve", "runs", "--memory-budget", "512"], "--session-memory"),
        (&["worker", "--engine", "nats://queue/night"], "--farm"),
        (&["bench", "--photos", "24"], "--photo-count"),
        (&["bench", "flow", "--photos=10,100"], "--photo-counts"),
        (&["bench", "clicks", "photos", "--clicks", "8"], "--clicks-per-object"),
    ] {
        refuses(args, 2, &[&format!("it is now {now}")]);
    }
    refuses(&["bench", "--table", "rivals"], 2, &["it is now `baselines`"]);
    let point = ["bench", "chart", "--only", "steps=1,look=none"];
    refuses(&point, 2, &["it is now `appearance_model`"]);
    let dir = folder();
    let file = dir.path().join("old.toml");
    std::fs::write(&file, "[train]\nlook = \"embed\"\n").expect("it is written");
    let (scene, out) = (show(scene()), show(&dir.path().join("out")));
    refuses(
        &["run", &scene, "--out", &out, "--config", &show(&file)],
        2,
        &["old.toml", "no setting `look`", "it is now `appearance_model`"],
    );
}

#[test]
fn completions_and_man_pages_know_every_command_and_flag() {
    for shell in ["bash", "zsh", "fish"] {
        let script = works(&["completions", shell]);
        assert!(script.contains("segment") && script.contains("appearance-model"), "{shell}: {script}");
    }
    let dir = folder();
    let written = works(&["man", "--out", &show(dir.path())]);
    assert!(written.lines().count() > 20, "{written}");
    let page = std::fs::read_to_string(dir.path().join("segwild-segment.1")).expect("a page");
    assert!(page.starts_with(".ie") && page.contains("granularity") && page.contains("Examples"), "{page}");
    assert!(dir.path().join("segwild-cache-gc.1").is_file(), "{written}");
}

#[test]
fn the_doctor_compares_the_kernels_of_an_accelerator() {
    refuses(&["doctor", "--kernels", "no such adapter"], 3, &["accelerator"]);
    if segwild(&["doctor"]).stdout.windows(6).any(|w| w == b"none: ") {
        println!("skipped: the_doctor_compares_the_kernels_of_an_accelerator: no accelerator answers");
        return;
    }
    let found = works(&["doctor"]);
    let device = found.lines().find(|line| line.contains("shared by a group")).expect("what it offers");
    assert!(device.contains("subgroups"), "{device}");
    let stderr = works(&["doctor", "--kernels"]);
    assert!(
        stderr.contains("project_backward") && stderr.lines().all(|line| line.contains("as on the CPU")),
        "{stderr}"
    );
}

#[test]
fn a_reader_that_is_gone_is_no_error() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_segwild"))
        .args(["doctor", "--settings"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("the program starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("it ends");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
}

#[test]
fn the_graph_of_the_stages_is_printed_without_a_scene() {
    let mermaid = works(&["run", "--explain", "--graph"]);
    assert!(
        mermaid.starts_with("flowchart LR\n") && mermaid.contains("sky -. \"sky*\" .-> geometry"),
        "{mermaid}"
    );
    let dot = works(&["run", "--explain", "--graph", "dot"]);
    assert!(dot.starts_with("digraph run {\n") && dot.trim_end().ends_with('}'), "{dot}");
    for (args, words) in [(&["run", "--graph"][..], "--explain"), (&["run"], "<SCENE>")] {
        let output = segwild(args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(text(&output.stderr).contains(words), "{}", text(&output.stderr));
    }
}
