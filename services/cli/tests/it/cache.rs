//! The cache of a run: damaged artefacts, listing, sweeping, a limit.

use crate::common::*;
use std::path::Path;

#[test]
fn a_damaged_artefact_is_made_again() {
    let dir = folder();
    let run = copied_run(&dir);
    let (stdout, _) = completes(&again(&run, &["--fault", "corrupt@cache.read:5", "--json"]));
    let summary = stdout.lines().last().expect("a summary");
    assert!(summary.contains("\"made\":1,"), "{summary}");
    same_as_untouched(&run);
}

#[test]
fn the_cache_is_listed_verified_and_swept() {
    let dir = folder();
    let path = copied_run(&dir);
    let run = show(&path);
    completes(&again(&path, &["--prompt-budget", "30"]));
    let list = works(&["cache", "ls", &run]);
    assert!(list.contains("masks") && list.contains("8 (") && list.contains("of other settings"), "{list}");
    assert!(works(&["cache", "verify", &run]).contains("0 damaged"));
    let dry = works(&["cache", "gc", &run, "--dry-run"]);
    let done = works(&["cache", "gc", &run]);
    assert_eq!(dry.split(',').next(), done.split(',').next());
    assert!(!works(&["cache", "ls", &run]).contains("other settings"));
    // What is used stays: nothing is made again.
    let (stdout, _) = completes(&again(&path, &["--prompt-budget", "30", "--json"]));
    assert!(stdout.lines().last().is_some_and(|l| l.contains("\"made\":0,")), "{stdout}");

    let folders = std::fs::read_dir(path.join("cache/masks.d")).expect("masks").flatten();
    let mut files = folders.flat_map(|folder| std::fs::read_dir(folder.path()).expect("a folder").flatten());
    let file = files.next().expect("a file").path();
    let mut bytes = std::fs::read(&file).expect("bytes");
    *bytes.last_mut().expect("a byte") ^= 1;
    std::fs::write(&file, bytes).expect("it is written");
    refuses(&["cache", "verify", &run], 6, &["1 of", "damaged", "computes them again"]);
    let (stdout, _) = completes(&again(&path, &["--prompt-budget", "30", "--json"]));
    assert!(stdout.lines().last().is_some_and(|l| l.contains("\"made\":1,")), "{stdout}");
    // A run may sweep behind itself.
    completes(&again(&path, &["--prompt-budget", "31"]));
    let (_, stderr) = completes(&again(&path, &["--prompt-budget", "31", "--cache-limit", "1"]));
    let bytes: u64 = works(&["cache", "ls", &run, "--json"])
        .split("\"bytes\":")
        .skip(1)
        .filter_map(|t| t.split(',').next()?.parse::<u64>().ok())
        .sum();
    assert!(bytes <= 1 << 20 || stderr.contains("left the cache"), "{bytes} {stderr}");
}

/// Bytes of a run's cache: all, and those that the run uses as it stands.
fn held(run: &Path) -> (u64, u64) {
    let lines = lines(&works(&["cache", "ls", &show(run), "--json"]));
    let sum = |field: &str| {
        lines.iter().map(|line| line[field].as_u64().unwrap_or_else(|| panic!("no {field}: {line}"))).sum()
    };
    (sum("bytes"), sum("used_bytes"))
}

#[test]
fn a_cache_limit_smaller_than_the_run_takes_nothing_that_the_run_needs_and_all_else() {
    let dir = folder();
    let run = copied_run(&dir);
    let (_, needed) = held(&run);
    // Other settings of every stage leave artefacts behind: of the training, the masks, the field.
    for other in [["--steps", "50"], ["--prompt-budget", "30"], ["--refine-steps", "5"], ["--until", "70"]] {
        completes(&again(&run, &other));
    }
    let (all, _) = held(&run);
    assert!(all > needed + (1 << 20), "the others left {} bytes beside {needed}", all - needed);
    completes(&again(&run, &["--cache-limit", "1"]));
    let (all, used) = held(&run);
    assert_eq!(used, needed, "what the run needs is there, and counted as such");
    assert!(all <= (1 << 20).max(needed), "{all} bytes are left of a limit of 1 MiB");
    has_what_an_untouched_run_has(&run);
    let (stdout, _) = completes(&again(&run, &["--cache-limit", "1", "--json"]));
    assert_eq!(made(&stdout), 0, "{stdout}");
    // Swept of everything else, nothing is missing either.
    works(&["cache", "gc", &show(&run)]);
    same_as_untouched(&run);
    let (stdout, _) = completes(&again(&run, &["--json"]));
    assert_eq!(made(&stdout), 0, "{stdout}");
}

#[test]
fn a_run_under_a_cache_limit_from_its_start_ends_in_the_same_bytes_also_when_it_is_killed() {
    let dir = folder();
    let run = dir.path().join("run");
    let limited = |more: &[&str]| again(&run, &[&["--cache-limit", "1"], more].concat());
    for fault in ["kill@masks.handle:14", "kill@features.step:9"] {
        assert_eq!(output(&limited(&["--fault", fault])).status.code(), None, "{fault}");
    }
    completes(&limited(&[]));
    same_as_untouched(&run);
}

#[test]
fn sweeping_keeps_the_checkpoints_of_a_training_that_went_past_its_steps() {
    let dir = folder();
    let run = dir.path().join("run");
    completes(&again(&run, &["--until", "80"]));
    works(&["cache", "gc", &show(&run)]);
    let (_, stderr) = completes(&again(&run, &["--until", "100"]));
    assert!(stderr.contains("goes on from step 80"), "{stderr}");
}

/// Damages the first artefact of a kind.
fn damage(run: &Path, kind: &str) {
    let folders = std::fs::read_dir(run.join(format!("cache/{kind}.d"))).expect("artefacts").flatten();
    let mut files = folders.flat_map(|folder| std::fs::read_dir(folder.path()).expect("a folder").flatten());
    let file = files.next().expect("a file").path();
    let mut bytes = std::fs::read(&file).expect("bytes");
    *bytes.last_mut().expect("a byte") ^= 1;
    std::fs::write(&file, bytes).expect("it is written");
}

#[test]
fn damage_of_any_kind_is_reported_once_and_made_again() {
    for kind in ["sky", "embedding", "masks", "visibility", "geometry", "snapshot", "history", "features"] {
        let dir = folder();
        let run = copied_run(&dir);
        damage(&run, kind);
        let (_, stderr) = completes(&again(&run, &[]));
        assert_eq!(stderr.matches(&format!("the cache's {kind} record")).count(), 1, "{kind}: {stderr}");
        assert!(stderr.contains("its hash does not fit its bytes): it is made again"), "{kind}: {stderr}");
        assert!(!stderr.contains("failed"), "{kind}: {stderr}");
        same_as_untouched(&run);
    }
}

#[test]
fn masks_that_were_damaged_and_cannot_be_made_again_end_the_run_and_change_nothing() {
    let dir = folder();
    let run = copied_run(&dir);
    damage(&run, "masks");
    let output = output(&again(&run, &["--fault", "fail@masks.make:1+"]));
    let stdout = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{stdout}");
    assert!(stdout.contains("damaged in the cache and cannot be made again"), "{stdout}");
    let name = Path::new("features.bin");
    assert_eq!(results(&run)[name], results(&shared_run().run)[name]);
    completes(&again(&run, &[]));
    same_as_untouched(&run);
}

#[test]
fn an_input_of_the_field_that_is_torn_when_it_is_read_is_made_again() {
    let dir = folder();
    let mut stdout = Vec::new();
    // Over all reads of a run that has everything but the field.
    for read in (12..84).step_by(6) {
        let run = dir.path().join(read.to_string());
        copy_folder(&shared_run().run, &run);
        std::fs::remove_dir_all(run.join("cache/features.d")).expect("it goes");
        let (_, stderr) = completes(&again(&run, &["--fault", &format!("torn@cache.read:{read}")]));
        let name = Path::new("features.bin");
        assert_eq!(results(&run)[name], results(&shared_run().run)[name], "read {read}: {stderr}");
        stdout.extend(stderr.lines().filter(|line| line.contains("made again")).map(str::to_owned));
        // What the report found damaged, the next run makes.
        completes(&again(&run, &[]));
        same_as_untouched(&run);
    }
    assert!(stdout.len() >= 8, "{stdout:#?}");
}

#[test]
fn a_photo_that_cannot_be_compared_with_the_scene_is_left_out_and_tried_again() {
    let dir = folder();
    let run = dir.path().join("run");
    let faults = [3, 4, 5].map(|n| format!("fail@visibility.photo:{n}"));
    let faults: Vec<&str> = faults.iter().flat_map(|fault| ["--fault", fault]).collect();
    let (_, stderr) = completes(&again(&run, &faults));
    assert_eq!(stderr.matches("visibility photo").count(), 1, "{stderr}");
    let name = Path::new("features.bin");
    assert_ne!(results(&run)[name], results(&shared_run().run)[name], "a photo less changes something");
    let args = again(&run, &["--explain"]);
    let plan = works(&args.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(plan.contains("given up before and tried again: visibility of"), "{plan}");
    completes(&again(&run, &[]));
    has_what_an_untouched_run_has(&run);
    // An error that passes costs an attempt.
    let other = dir.path().join("other");
    completes(&again(&other, &["--fault", "fail@visibility.photo:3"]));
    same_as_untouched(&other);
}

#[test]
fn a_photo_that_cannot_be_scored_or_rendered_is_named_and_the_others_go_on() {
    let dir = folder();
    let run = dir.path().join("run");
    let faults =
        ["evaluate.photo:1", "evaluate.photo:2", "evaluate.photo:3", "report.image:2", "report.image:3"];
    let faults = faults.map(|fault| format!("fail@{fault}"));
    let faults: Vec<&str> = faults.iter().flat_map(|fault| ["--fault", fault]).collect();
    let (_, stderr) = completes(&again(&run, &faults));
    assert!(stderr.contains("is not scored: a fault on purpose"), "{stderr}");
    assert!(stderr.contains("is not shown whole in the report"), "{stderr}");
    let scores = json(&std::fs::read(run.join("evaluation.json")).expect("scores"));
    assert_eq!(scores["photos"].as_array().map(Vec::len), Some(1), "{scores}");
    let args = again(&run, &["--explain"]);
    let plan = works(&args.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(plan.contains("given up before and tried again: evaluate of"), "{plan}");
    completes(&again(&run, &[]));
    same_as_untouched(&run);
    let other = dir.path().join("other");
    completes(&again(&other, &["--fault", "fail@evaluate.photo:1", "--fault", "fail@report.image:2"]));
    same_as_untouched(&other);
}

#[test]
fn a_click_takes_the_regions_of_photos_from_the_cache_and_does_without_it() {
    let dir = folder();
    let run = copied_run(&dir);
    let (_, click) = clearest();
    let at = format!("{},{}", click.x, click.y);
    let regions = run.join("cache/regions.d");
    let select = |name: &str| {
        let args = ["segment", &show(&run), "--photo", &click.photo, "--positive", &at, "--name", name];
        let output = output(&args.map(str::to_owned));
        assert!(output.status.success(), "{name}: {}", text(&output.stderr));
        std::fs::read(run.join("selections").join(name).join("object.ply")).expect("an object")
    };
    let seen = held_of(&run, "regions");
    assert_eq!(seen, 10, "the run saw its photos");
    let object = select("first");
    assert_eq!(held_of(&run, "regions"), seen, "there was nothing to look for");
    damage(&run, "regions");
    assert!(select("damaged") == object);
    std::fs::remove_dir_all(&regions).expect("it goes");
    assert!(select("gone") == object);
    assert!(held_of(&run, "regions") > 0, "the click kept what it saw");
    // A file where a folder is wanted.
    std::fs::remove_dir_all(&regions).expect("it goes");
    std::fs::write(&regions, "a file").expect("it is written");
    assert!(select("occupied") == object);
}

#[test]
fn a_click_starts_from_the_runs_scene_tree_and_names_what_else_it_may_mean() {
    let dir = folder();
    let run = copied_run(&dir);
    let (_, click) = clearest();
    let at = format!("{},{}", click.x, click.y);
    let select = |more: &[&str]| {
        let run = show(&run);
        let args =
            [&["segment", &run, "--photo", &click.photo, "--positive", &at, "--json"][..], more].concat();
        json(works(&args).as_bytes())
    };
    assert_eq!(held_of(&run, "objects"), 1, "the run grew its tree");
    let first = select(&[]);
    let alternatives = first["alternatives"].as_array().expect("a list").clone();
    assert!((2..=4).contains(&alternatives.len()), "{first}");
    assert_eq!(
        alternatives.iter().filter(|m| *m == "photo").count(),
        1,
        "the photo's own mask is one of them"
    );
    let splats: Vec<u64> = (0..alternatives.len())
        .map(|i| {
            let other = select(&["--alternative", &i.to_string()]);
            assert_eq!(
                other["alternatives"], first["alternatives"],
                "they are the same whichever is selected"
            );
            other["splats"].as_u64().expect("a count")
        })
        .collect();
    assert_eq!(splats[0], first["splats"].as_u64().expect("a count"));
    let run_text = show(&run);
    let beyond = ["segment", &run_text, "--photo", &click.photo, "--positive", &at, "--alternative", "7"];
    let offered = format!("there are {}: 0, 1", alternatives.len());
    refuses(&beyond, 2, &["no alternative 7", &offered]);
    let by_photo = select(&["--first-answer", "photo"]);
    assert_eq!(by_photo["alternatives"], serde_json::json!([]));
    let photo = alternatives.iter().position(|m| m == "photo").expect("it is there");
    assert_eq!(by_photo["splats"].as_u64(), Some(splats[photo]), "it is the answer without the tree");
    // A tree that is damaged or gone is grown again, and the answer stays.
    damage(&run, "objects");
    assert_eq!(select(&[])["splats"], first["splats"]);
    std::fs::remove_dir_all(run.join("cache/objects.d")).expect("it goes");
    assert_eq!(select(&[])["splats"], first["splats"]);
    assert_eq!(held_of(&run, "objects"), 1, "the click kept the tree");
}

/// Artefacts of a kind in a run's cache.
fn held_of(run: &Path, kind: &str) -> u64 {
    let lines = lines(&works(&["cache", "ls", &show(run), "--json"]));
    lines.iter().filter(|line| line["kind"] == kind).filter_map(|line| line["files"].as_u64()).sum()
}

#[test]
fn a_damaged_transient_mask_is_named_by_verify_and_by_segment() {
    let dir = folder();
    let run = copied_run(&dir);
    let photo = shared_run().manifest.photos.iter().find(|p| !p.test).expect("one is trained on");
    let file = run.join("transients").join(Path::new(&photo.name).with_extension("png"));
    let mut bytes = std::fs::read(&file).expect("an image");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&file, bytes).expect("it is written");
    let what = ["1 of", "transient masks are damaged"];
    refuses(&["cache", "verify", &show(&run)], 6, &what);
    let (_, click) = clearest();
    let at = format!("{},{}", click.x, click.y);
    let output = segwild(&["segment", &show(&run), "--photo", &click.photo, "--positive", &at]);
    let stdout = text(&output.stdout) + &text(&output.stderr);
    assert!(output.status.success(), "{stdout}");
    assert!(stdout.contains(&show(&file)) && stdout.contains("is passed over"), "{stdout}");
}

#[test]
fn a_photo_much_larger_than_it_is_used_is_kept_in_the_cache_and_a_run_without_that_is_the_same() {
    let dir = folder();
    let (kept, decoded) = (dir.path().join("kept"), dir.path().join("decoded"));
    // The photos have 96 pixels.
    let small = |out: &Path, until: &str| {
        completes(&again(out, &["--size", "40", "--steps", "20", "--until", until]))
    };
    small(&kept, "geometry");
    let line = |run: &Path| {
        let lines = lines(&works(&["cache", "ls", &show(run), "--json"]));
        lines.into_iter().find(|line| line["kind"] == "photo")
    };
    assert_eq!(line(&kept).expect("photos")["files"], 10);
    // Where a folder of the cache cannot be made, photos are decoded whenever they are needed.
    std::fs::create_dir_all(decoded.join("cache")).expect("a folder");
    std::fs::write(decoded.join("cache/photo.d"), "in the way").expect("a file");
    small(&decoded, "geometry");
    assert_eq!(line(&decoded), None);
    let model = |run: &Path| std::fs::read(run.join("model.bin")).expect("a model");
    assert!(model(&kept) == model(&decoded), "a photo from the cache is another one");
    // Damaged ones are decoded again, by a run that needs them.
    damage(&kept, "photo");
    let (_, stderr) = small(&kept, "masks");
    assert_eq!(stderr.matches("the cache's record of a photo was damaged").count(), 1, "{stderr}");
    assert!(works(&["cache", "verify", &show(&kept)]).contains("0 damaged"));
}
