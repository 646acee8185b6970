//! What an operator counts on: killed, torn, full, read-only, in use: a sentence and an exit code, nothing lost, and in
//! the end the same bytes.

use crate::common::*;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command};

#[test]
fn until_a_step_and_on_from_there_is_the_same_as_straight() {
    let dir = folder();
    let run = dir.path().join("run");
    let (stdout, _) = completes(&again(&run, &["--until", "20"]));
    assert!(stdout.contains("stopped at step 20"), "{stdout}");
    assert!(!run.join("model.bin").exists());
    let status = works(&["status", &show(&run), "--json"]);
    assert!(status.contains("\"pending\"") && !status.contains("\"running\":true"), "{status}");
    // How long the training stood still for want of skies, and what a checkpoint costs.
    for number in ["geometry.stall_s", "geometry.checkpoint_s"] {
        assert!(status.contains(number), "{number}: {status}");
    }
    let (_, stderr) = completes(&again(&run, &["--until", "40"]));
    assert!(stderr.contains("goes on from step 20"), "{stderr}");
    // A run until a step that was reached already has nothing to do.
    let (stdout, _) = completes(&again(&run, &["--until", "30"]));
    assert!(stdout.contains("stopped at step 40"), "{stdout}");
    completes(&again(&run, &[]));
    same_as_untouched(&run);

    // Past the settings' own steps: from the end of this run, and straight from nothing.
    let straight = dir.path().join("straight");
    completes(&again(&straight, &["--until", "80"]));
    let (_, stderr) = completes(&again(&run, &["--until", "80"]));
    assert!(stderr.contains("goes on from step 60"), "{stderr}");
    let model = |run: &Path| std::fs::read(run.join("model.bin")).expect("a model");
    assert!(model(&run) == model(&straight));
    assert!(model(&run) != model(&shared_run().run), "twenty more steps change something");
    refuses(&["run", "x", "--until", "geometri"], 2, &["geometri", "geometry", "training steps"]);
}

#[test]
fn a_scene_in_two_blocks_stops_within_a_block_and_goes_on_to_the_same_bytes() {
    let dir = folder();
    let (straight, stopped) = (dir.path().join("straight"), dir.path().join("stopped"));
    let blocks = ["--blocks", "2", "--until", "geometry"];
    let (stdout, _) = completes(&again(&straight, &blocks));
    assert!(stdout.contains("seams: trained in 2 blocks"), "{stdout}");
    let seams = json(&std::fs::read(straight.join("seams.json")).expect("how the seams are shown"));
    assert_eq!(seams["blocks"], 2, "{seams}");
    // The coarse training takes 15 of the 60 steps, the seams the last 6.
    completes(&again(&stopped, &["--blocks", "2", "--until", "25"]));
    let (_, stderr) = completes(&again(&stopped, &blocks));
    assert!(stderr.contains("goes on from step 25"), "{stderr}");
    let file = |run: &Path, name: &str| std::fs::read(run.join(name)).expect("it is there");
    for name in ["model.bin", "seams.json"] {
        assert!(file(&stopped, name) == file(&straight, name), "{name}");
    }
    let whole = file(&shared_run().run, "model.bin");
    assert!(file(&straight, "model.bin") != whole, "blocks change something");
}

#[test]
fn a_torn_checkpoint_is_passed_over_for_the_one_before_and_named() {
    for damage in ["torn", "flipped", "gone"] {
        let dir = folder();
        let run = dir.path().join("run");
        for step in ["20", "40"] {
            completes(&again(&run, &["--until", step]));
        }
        let checkpoints = || std::fs::read_dir(run.join("checkpoints")).expect("a folder").flatten();
        let newest = checkpoints().map(|e| e.path()).max().expect("a checkpoint");
        let mut bytes = std::fs::read(&newest).expect("a checkpoint");
        match damage {
            "torn" => bytes.truncate(bytes.len() / 2),
            _ => bytes[1000] ^= 1,
        }
        std::fs::write(&newest, bytes).expect("it is written");
        if damage == "gone" {
            std::fs::remove_file(&newest).expect("it goes");
        }
        let (_, stderr) = completes(&again(&run, &[]));
        assert!(stderr.contains("-00000040.bin is passed over"), "{stderr}");
        assert!(stderr.contains("goes on from step 20"), "{stderr}");
        same_as_untouched(&run);
        let kept = checkpoints().count();
        assert!(kept <= 2, "{kept} checkpoints are kept, not 2");
    }
}

#[test]
fn a_panic_and_a_passing_error_cost_an_attempt_and_nothing_else() {
    let dir = folder();
    let run = dir.path().join("run");
    let faults = ["--fault", "panic@masks.handle:2", "--fault", "fail@features.handle:3"];
    let (_, stderr) = completes(&again(&run, &faults));
    assert!(stderr.contains("masks was restarted: panic: a fault on purpose"), "{stderr}");
    same_as_untouched(&run);
}

#[test]
fn a_trainer_that_panics_twice_ends_the_run_in_words_instead_of_a_wait_for_ever() {
    let dir = folder();
    let run = dir.path().join("run");
    let output = output(&again(&run, &["--fault", "panic@trainer.handle:1+"]));
    let stdout = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{stdout}");
    assert!(stdout.contains("stage `geometry` failed: panic: a fault on purpose"), "{stdout}");
    completes(&again(&run, &[]));
    same_as_untouched(&run);
}

#[test]
fn a_trainer_that_panics_once_goes_on_from_its_last_checkpoint() {
    let dir = folder();
    let run = dir.path().join("run");
    completes(&again(&run, &["--until", "20"]));
    let (_, stderr) = completes(&again(&run, &["--fault", "panic@trainer.step:15"]));
    assert_eq!(stderr.matches("goes on from step 20").count(), 2, "{stderr}");
    same_as_untouched(&run);
    // Without a checkpoint, from the start.
    let other = dir.path().join("other");
    completes(&again(&other, &["--fault", "panic@trainer.step:45"]));
    same_as_untouched(&other);
}

#[test]
fn an_actor_that_fails_at_everything_is_no_stop_by_the_user() {
    let dir = folder();
    let run = dir.path().join("run");
    let output = output(&again(&run, &["--fault", "fail@masks.handle:1+"]));
    let stdout = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{stdout}");
    assert!(stdout.contains("stage `sky` failed: not one of 10 photos"), "{stdout}");
}

#[test]
fn a_stage_that_can_do_none_of_its_photos_fails_however_few_there_are() {
    let dir = folder();
    let run = dir.path().join("run");
    // Ten skies come first, then the masks of eight photos.
    let output = output(&again(&run, &["--fault", "fail@masks.handle:11+"]));
    let stdout = text(&output.stderr);
    assert_eq!(output.status.code(), Some(4), "{stdout}");
    assert!(stdout.contains("stage `masks` failed: not one of 8 photos"), "{stdout}");
    assert!(stdout.contains("the first:") && stdout.contains("a fault on purpose"), "{stdout}");
    // Five of eight are a reason to look, and none to stop.
    let faults: Vec<String> = (11..26).map(|n| format!("fail@masks.handle:{n}")).collect();
    let faults: Vec<&str> = faults.iter().flat_map(|fault| ["--fault", fault]).collect();
    let (_, stderr) = completes(&again(&run, &faults));
    assert!(stderr.contains("warning 5 of 8 photos could not be done (masks); the first:"), "{stderr}");
    completes(&again(&run, &[]));
    has_what_an_untouched_run_has(&run);
}

#[test]
fn a_memory_budget_that_cannot_be_kept_is_refused_with_the_number() {
    let dir = folder();
    let args = again(&dir.path().join("run"), &["--memory-budget", "40"]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refuses(&args, 2, &["needs about", "MiB", "allows 40", "--splats"]);
    let run = dir.path().join("small");
    completes(&again(&run, &["--memory-budget", "160"]));
    same_as_untouched(&run);
}

#[test]
fn one_kept_checkpoint_is_the_newest_and_a_damaged_one_costs_the_training_and_no_more() {
    let dir = folder();
    let run = dir.path().join("run");
    let one = ["--keep-checkpoints", "1"];
    let checkpoints = || {
        let names = std::fs::read_dir(run.join("checkpoints")).expect("a folder").flatten();
        let mut names: Vec<String> = names.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    };
    for step in ["20", "40"] {
        completes(&again(&run, &[&one[..], &["--until", step]].concat()));
        let kept = checkpoints();
        let ending = format!("-{step:0>8}.bin");
        assert!(kept.len() == 1 && kept[0].ends_with(&ending), "after step {step}: {kept:?}");
    }
    let newest = run.join("checkpoints").join(&checkpoints()[0]);
    let mut bytes = std::fs::read(&newest).expect("a checkpoint");
    bytes.truncate(bytes.len() / 2);
    std::fs::write(&newest, bytes).expect("it is written");
    let (_, stderr) = completes(&again(&run, &one));
    assert!(stderr.contains("-00000040.bin is passed over"), "{stderr}");
    assert!(stderr.contains("there is none before it: the training starts again from step 0"), "{stderr}");
    assert!(!stderr.contains("goes on from step"), "there is none to go on from: {stderr}");
    assert!(checkpoints().len() <= 1, "{:?}", checkpoints());
    same_as_untouched(&run);
}

#[test]
fn checkpoints_are_used_when_the_ledger_is_lost_and_the_loss_is_reported() {
    for (loss, step) in [("has gone", 40), ("is empty", 20)] {
        let dir = folder();
        let run = dir.path().join("run");
        for step in ["20", "40"] {
            completes(&again(&run, &["--until", step]));
        }
        for file in ["run.sqlite-wal", "run.sqlite-shm", "run.sqlite"] {
            // The first two are there only where the last writer was killed.
            let _ = std::fs::remove_file(run.join(file));
        }
        if loss == "is empty" {
            std::fs::write(run.join("run.sqlite"), "").expect("it is written");
            let newest = std::fs::read_dir(run.join("checkpoints")).expect("a folder").flatten();
            let newest = newest.map(|e| e.path()).max().expect("a checkpoint");
            std::fs::write(newest, "torn").expect("it is written");
        }
        let (_, stderr) = completes(&again(&run, &[]));
        assert!(stderr.contains(&format!("run.sqlite {loss}")), "{stderr}");
        assert!(stderr.contains("is lost; the cache and the checkpoints are kept and used"), "{stderr}");
        assert!(stderr.contains(&format!("goes on from step {step}")), "{stderr}");
        same_as_untouched(&run);
    }
}

#[test]
fn explain_names_what_would_be_done_again_and_why() {
    let dir = folder();
    let run = copied_run(&dir);
    let plan = |scene: &Path, more: &[&str]| -> BTreeMap<String, (String, String)> {
        let (scene, out) = (show(scene), show(&run));
        let args = [&["run", &scene, "--out", &out, "--explain", "--json"], more].concat();
        let plans = lines(&works(&args));
        let text = |v: &serde_json::Value| v.as_str().unwrap_or_default().to_owned();
        plans.iter().map(|p| (text(&p["stage"]), (text(&p["verdict"]), p["why"].to_string()))).collect()
    };
    let scene = shared_run().scene.clone();
    let done_again = |plan: &BTreeMap<String, (String, String)>| -> Vec<String> {
        plan.iter().filter(|(_, (verdict, _))| verdict != "reused").map(|(stage, _)| stage.clone()).collect()
    };
    let before = results(&run);
    assert_eq!(done_again(&plan(&scene, &[])), ["report"]);
    let channels = plan(&scene, &["--channels", "16"]);
    assert_eq!(done_again(&channels), ["features", "report"]);
    assert!(channels["features"].1.contains("channels: 64 -> 16"), "{channels:?}");
    let steps = plan(&scene, &["--steps", "61", "--channels", "16", "--tau", "0.4"]);
    assert_eq!(done_again(&steps), ["evaluate", "features", "geometry", "masks", "objects", "report"]);
    assert_eq!(steps["geometry"].1, "[\"steps: 60 -> 61\"]");
    assert!(steps["features"].1.contains("channels") && steps["features"].1.contains("steps"), "{steps:?}");
    // Memory changes nothing that is made.
    assert_eq!(done_again(&plan(&scene, &["--photo-cache-mib", "7", "--feature-memory", "7"])), ["report"]);
    let more = plan(&scene, &["--until", "80"]);
    assert_eq!(more["geometry"].0, "goes_on", "{more:?}");
    assert!(results(&run) == before, "nothing was done");

    // Another photo under the same name; a run that does not exist.
    let other = dir.path().join("scene");
    copy_folder(&scene, &other);
    let names: Vec<_> =
        shared_run().manifest.photos.iter().filter(|p| !p.test).map(|p| p.name.clone()).collect();
    let photo = other.join("images").join(&names[0]);
    let mut image = segwild_scene::Image::read(&photo).expect("an image");
    image.data[0] = 1.0 - image.data[0];
    image.write_png(&photo).expect("it is written");
    let changed = plan(&other, &[]);
    assert_eq!(changed["sky"].0, "partly", "{changed:?}");
    assert!(changed["sky"].1.contains(&format!("{} has changed", names[0])), "{changed:?}");
    let nowhere = show(&dir.path().join("new"));
    let stdout = works(&["run", &show(&scene), "--out", &nowhere, "--explain"]);
    assert!(stdout.contains("geometry  made") && stdout.contains("the run is new"), "{stdout}");
    assert!(!Path::new(&nowhere).exists(), "explaining makes nothing");
}

#[test]
fn explain_says_of_any_step_what_the_run_then_does() {
    let dir = folder();
    let run = dir.path().join("run");
    // Explains, runs, and compares what the training does.
    let check = |more: &[&str], expected: &str, words: &[&str]| {
        let (plan, _) = completes(&again(&run, &[more, &["--explain"]].concat()));
        let (stdout, stderr) = completes(&again(&run, more));
        let line = plan.lines().find(|line| line.trim_start().starts_with("geometry")).expect("a line");
        assert!(line.contains(expected), "{more:?} was to be `{expected}`: {plan}");
        for word in words {
            assert!(line.contains(word), "{more:?} does not say `{word}`: {plan}");
        }
        let on = stderr.lines().find_map(|l| l.split("goes on from step ").nth(1));
        match expected.split_once(" step ") {
            Some(("goes on from", step)) => assert_eq!(on, Some(step), "{more:?}: {stderr}"),
            Some(_) => {
                assert!(stdout.contains(&format!("stopped at {}", &expected[10..])), "{more:?}: {stdout}")
            }
            None => assert_eq!(on, None, "{more:?}: {stderr}"),
        }
        assert_eq!(stderr.contains("geometry was done before"), expected == "reused", "{more:?}: {stderr}");
        for stage in ["features", "evaluate"] {
            let reused = plan.lines().any(|l| l.contains(stage) && l.contains("reused"));
            let done = stderr.contains(&format!("{stage} done in"));
            assert!(!(reused && done), "{more:?}: {stage} was to be reused: {stderr}");
            let named = plan.lines().any(|l| l.contains(stage));
            assert_eq!(named && !reused, done, "{more:?}: {stage}: {plan}{stderr}");
        }
        assert!(!plan.contains("points or cameras"), "nothing of the kind: {plan}");
    };
    check(&["--until", "20"], "made", &["the run is new"]);
    check(&["--until", "10"], "stands at step 20", &[]);
    check(&["--until", "100"], "goes on from step 20", &["end at step 100", "was to end at step 10"]);
    check(&["--until", "100"], "reused", &[]);
    check(&["--until", "120"], "goes on from step 100", &["end at step 120", "was to end at step 100"]);
    check(&["--until", "80"], "made", &["end at step 80", "was to end at step 120", "no checkpoint"]);
    check(&["--until", "110"], "goes on from step 100", &["end at step 110", "was to end at step 80"]);
    works(&["cache", "gc", &show(&run)]);
    check(&[], "made", &["end at step 60", "was to end at step 110", "no checkpoint"]);
    has_what_an_untouched_run_has(&run);
}

#[test]
fn a_second_process_is_refused_and_may_read() {
    let dir = folder();
    let run = dir.path().join("run");
    let mut first = start(&again(&run, &["--fault", "stall@masks.handle:3"]));
    wait_for(&mut first, "it holds the run", || run.join("scene.json").is_file());
    let pid = first.id().to_string();
    let args = again(&run, &[]);
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    refuses(&args, 6, &["in use by process", &pid]);
    refuses(&["cache", "gc", &show(&run)], 6, &["in use by process", &pid]);
    assert!(works(&["status", &show(&run)]).contains(&pid));
    works(&["cache", "ls", &show(&run)]);
    works(&[&args[..], &["--explain"]].concat());
    first.kill().expect("it can be killed");
    first.wait().expect("it ends");
    completes(&again(&run, &[]));
    same_as_untouched(&run);
}

#[cfg(unix)]
fn signal(child: &Child, signal: &str) {
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status();
    assert!(sent.expect("`kill` is there").success());
}

#[cfg(unix)]
#[test]
fn ctrl_c_once_stops_in_order_and_twice_at_once_and_both_go_on() {
    let dir = folder();
    let run = dir.path().join("run");
    // An actor that has stopped answering cannot stop in order; the second signal does not wait for it.
    for (presses, fault) in [(1, "fail@masks.handle:999"), (2, "stall@masks.handle:3")] {
        let mut child = start(&again(&run, &["--steps", "4000", "--fault", fault]));
        let pid = child.id().to_string();
        wait_for(&mut child, "it holds the run", || {
            std::fs::read_to_string(run.join("run.lock")).is_ok_and(|owner| owner.trim() == pid)
        });
        if presses == 1 {
            wait_for(&mut child, "it trains", || {
                std::fs::read_to_string(run.join("history.jsonl")).is_ok_and(|lines| !lines.is_empty())
            });
        }
        for _ in 0..presses {
            signal(&child, "-INT");
            // Two signals within an instant are one.
            std::thread::park_timeout(std::time::Duration::from_millis(300));
        }
        let output = child.wait_with_output().expect("it ends");
        let stdout = text(&output.stderr);
        assert_eq!(output.status.code(), Some(130), "{stdout}");
        assert!(stdout.contains("stopping where the run can continue"), "{stdout}");
    }
    completes(&again(&run, &["--steps", "60"]));
    has_what_an_untouched_run_has(&run);
}

#[test]
fn a_clock_that_jumps_changes_nothing() {
    let dir = folder();
    let run = dir.path().join("run");
    completes(&again(&run, &["--fault", "jump@clock:30+"]));
    same_as_untouched(&run);
    let status = works(&["status", &show(&run)]);
    assert!(!status.contains("-8") && status.contains("geometry  done"), "{status}");
}

#[test]
fn another_scene_is_not_run_into_a_used_folder() {
    let dir = folder();
    let run = copied_run(&dir);
    // The same scene elsewhere goes on.
    let moved = dir.path().join("moved");
    copy_folder(scene(), &moved);
    works(&[&["run", &show(&moved), "--out", &show(&run)][..], &QUICK].concat());
    // Photos of the same names from other folders are another scene.
    let sparse = moved.join("sparse/0");
    let mut model = segwild_scene::colmap::read(&sparse).expect("a model");
    model.images.iter_mut().for_each(|image| image.translation = image.translation.map(|v| 3.0 * v));
    model.points.iter_mut().for_each(|point| point.position = point.position.map(|v| 3.0 * v));
    let other = dir.path().join("other");
    copy_folder(&moved, &other);
    segwild_scene::colmap::write(&other.join("sparse/0"), &model).expect("it is written");
    let (other, run) = (show(&other), show(&run));
    let args = [&["run", &other, "--out", &run][..], &QUICK].concat();
    refuses(&args, 2, &["the run of another scene", "moved", "give `--out` another folder"]);
    refuses(&[&args[..], &["--explain"]].concat(), 2, &["the run of another scene"]);
    std::fs::write(Path::new(&run).join("scene.json"), "{\"scene\":").expect("it is written");
    refuses(&["bake", &run], 6, &["scene.json", "segwild run SCENE --out"]);
    works(&[&["run", &show(&moved), "--out", &run][..], &QUICK].concat());
    // What needs the photos says how to go on where they are gone.
    std::fs::remove_dir_all(&moved).expect("they go");
    refuses(&["bake", &run], 3, &["the photos of this run are not there", "segwild run NEWPATH --out"]);
}
