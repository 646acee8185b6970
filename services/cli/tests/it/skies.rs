//! A photo whose sky was given up: the run goes on without it, and what it makes is never taken for what a run with that
//! sky makes, nor the other way round.

use crate::common::*;

/// The third photo's sky fails three times, and is given up.
const GIVEN_UP: [&str; 6] =
    ["--fault", "fail@masks.handle:3", "--fault", "fail@masks.handle:4", "--fault", "fail@masks.handle:5"];

/// As [`GIVEN_UP`], with more.
fn given_up(more: &[&'static str]) -> Vec<&'static str> {
    [&GIVEN_UP[..], more].concat()
}

#[test]
fn a_sky_that_failed_once_does_not_spoil_the_run_in_which_it_works() {
    let dir = folder();
    let run = dir.path().join("run");
    let (_, stderr) = completes(&again(&run, &GIVEN_UP));
    assert!(stderr.contains("sky photo") && stderr.contains("a fault on purpose"), "{stderr}");
    let failed = stderr.lines().filter(|line| line.contains(" failed: a fault on purpose")).count();
    assert_eq!(failed, 1, "it is reported once, by the photo's name: {stderr}");
    let ledger = segwild_flow::Ledger::open_read_only(run.join("run.sqlite")).expect("a ledger");
    let attempts: Vec<u32> =
        ledger.views("sky").expect("rows").iter().map(|row| row.outcome.attempts).collect();
    assert_eq!(attempts.iter().filter(|&&n| n == 3).count(), 1, "as often as it was tried: {attempts:?}");
    let without = results(&run);
    let name = std::path::Path::new("model.bin");
    assert_ne!(without[name], results(&shared_run().run)[name], "a sky that is missing changes something");
    // It says what it will do again, and why.
    let args = again(&run, &["--explain"]);
    let plan = works(&args.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(plan.contains("given up before and tried again: sky of"), "{plan}");
    completes(&again(&run, &[]));
    has_what_an_untouched_run_has(&run);
    // And back: nothing of the run with all skies is taken for what there is without one.
    completes(&again(&run, &GIVEN_UP));
    has_all_of(&run, &without);
}

#[test]
fn a_run_with_all_skies_does_not_spoil_one_in_which_a_sky_fails() {
    let dir = folder();
    let alone = dir.path().join("alone");
    completes(&again(&alone, &GIVEN_UP));
    let after = dir.path().join("after");
    copy_folder(&shared_run().run, &after);
    completes(&again(&after, &GIVEN_UP));
    has_all_of(&after, &results(&alone));
}

#[test]
fn a_sky_that_always_fails_costs_no_second_training_and_survives_a_kill() {
    let dir = folder();
    let (straight, killed) = (dir.path().join("straight"), dir.path().join("killed"));
    completes(&again(&straight, &GIVEN_UP));
    let (stdout, stderr) = completes(&again(&straight, &given_up(&["--json"])));
    assert_eq!(made(&stdout), 0, "{stdout}");
    assert!(stdout.contains("stage_skipped") && !stdout.contains("goes on from step"), "{stdout}{stderr}");
    for fault in ["kill@trainer.step:45", "kill@masks.handle:14"] {
        let output = output(&again(&killed, &given_up(&["--checkpoint-every", "1", "--fault", fault])));
        assert_eq!(output.status.code(), None, "{}", text(&output.stderr));
    }
    completes(&again(&killed, &GIVEN_UP));
    has_all_of(&killed, &results(&straight));
}

#[test]
fn masks_that_failed_once_do_not_spoil_the_field_of_the_run_in_which_they_work() {
    let dir = folder();
    let run = dir.path().join("run");
    // Ten skies come first, then the masks of eight photos.
    let faults = [
        "--fault",
        "fail@masks.handle:12",
        "--fault",
        "fail@masks.handle:13",
        "--fault",
        "fail@masks.handle:14",
    ];
    completes(&again(&run, &faults));
    let name = std::path::Path::new("features.bin");
    assert_ne!(
        results(&run)[name],
        results(&shared_run().run)[name],
        "masks that are missing change something"
    );
    completes(&again(&run, &[]));
    has_what_an_untouched_run_has(&run);
}

#[test]
fn a_sky_that_is_damaged_while_the_run_uses_it_is_found_again_and_named() {
    let dir = folder();
    for fault in ["corrupt@cache.read:2", "torn@cache.read:11"] {
        let run = dir.path().join(fault);
        let (_, stderr) = completes(&again(&run, &["--fault", fault]));
        assert!(stderr.contains("the cache's sky record of photo"), "{fault}: {stderr}");
        assert!(stderr.contains("it is made again"), "{fault}: {stderr}");
        same_as_untouched(&run);
    }
}

#[test]
fn a_click_finds_the_skies_again_that_have_gone_from_the_cache() {
    let dir = folder();
    let run = copied_run(&dir);
    let selected = || {
        let stdout = select(&run, &[]);
        assert!(stdout.status.success(), "{stdout:?}");
        std::fs::read(run.join("selections/it/selection.bin")).expect("a selection")
    };
    let before = selected();
    std::fs::remove_dir_all(run.join("cache/sky.d")).expect("the run has found skies");
    assert!(selected() == before, "the same bytes");
}
