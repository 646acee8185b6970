//! The coordinator with simulated actors: which stage starts when, whatever the order of the answers.

use crate::simulated::{PHOTOS, SPLATS, Seen, Simulated, settings, write_scene, write_scene_of};
use segwild_flow::ledger::State;
use segwild_flow::{Event, Events, Ledger, files};
use segwild_pipeline::{
    DescribedPhotos, RunError, RunFolder, RunOptions, Stage, Summary, Until, run_with_actors,
};
use std::collections::BTreeSet;
use std::path::Path;

/// A scene and a folder for runs.
fn scene() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a temporary folder");
    write_scene(&dir.path().join("scene"));
    dir
}

fn run(dir: &Path, name: &str, until: Until, actors: &Simulated) -> Result<Summary, RunError> {
    let folder = RunFolder::create(&dir.join(name))?;
    let options = RunOptions { until: Some(until), ..RunOptions::default() };
    run_with_actors(&dir.join("scene"), &folder, &settings(), &options, actors)
}

const FEATURES: Until = Until::Stage(Stage::Features);

/// Where something stands in the log.
fn at(log: &[Seen], seen: &Seen) -> usize {
    log.iter().position(|s| s == seen).unwrap_or_else(|| panic!("no {seen:?} in {log:#?}"))
}

/// Where the last answer of a stage that goes photo by photo stands in the log.
fn last(log: &[Seen], stage: Stage) -> usize {
    (0..PHOTOS).map(|view| at(log, &Seen::Answered(stage, Some(view)))).max().expect("photos")
}

fn bytes(dir: &Path, file: &str) -> Vec<u8> {
    files::read_plain(&dir.join(file)).expect("it is there")
}

#[test]
fn stages_start_when_all_that_they_need_is_there_whatever_the_order_of_the_answers() {
    let dir = scene();
    let mut orders = Vec::new();
    for seed in 0..12 {
        let actors = Simulated { seed, ..Simulated::default() };
        let name = format!("run {seed}");
        let summary = run(dir.path(), &name, FEATURES, &actors).expect("it runs");
        assert_eq!((summary.splats, summary.skipped.len(), summary.made), (SPLATS, 0, 3 * PHOTOS));
        let log = actors.log();
        let ordered = |stage, view| at(&log, &Seen::Ordered(stage, view));
        for view in 0..PHOTOS {
            let masks = ordered(Stage::Masks, Some(view));
            assert!(masks > at(&log, &Seen::Snapshot), "seed {seed}: {log:#?}");
            assert!(masks > last(&log, Stage::Sky), "seed {seed}: {log:#?}");
        }
        let field = ordered(Stage::Features, None);
        assert!(field > last(&log, Stage::Sky) && field > last(&log, Stage::Embed), "seed {seed}: {log:#?}");
        assert!(field > at(&log, &Seen::Answered(Stage::Geometry, None)), "seed {seed}: {log:#?}");
        // The order changes nothing of the result.
        for file in ["model.bin", "features.bin"] {
            let (first, this) = (dir.path().join("run 0"), dir.path().join(&name));
            assert!(bytes(&first, file) == bytes(&this, file), "seed {seed}: {file}");
        }
        orders.push(log.into_iter().filter(|s| matches!(s, Seen::Answered(..))).collect::<Vec<_>>());
    }
    orders.sort_by_key(|order| format!("{order:?}"));
    orders.dedup();
    assert!(orders.len() > 6, "the answers come in many orders: {}", orders.len());
}

#[test]
fn masks_are_made_while_the_training_goes_on() {
    let dir = scene();
    let actors = Simulated { trains_until_masks: true, ..Simulated::default() };
    run(dir.path(), "run", FEATURES, &actors).expect("it runs");
    let log = actors.log();
    let first = log.iter().position(|s| matches!(s, Seen::Ordered(Stage::Masks, _))).expect("masks");
    assert!(first < at(&log, &Seen::Answered(Stage::Geometry, None)), "{log:#?}");
}

#[test]
fn a_photo_that_a_stage_gives_up_is_named_and_left_out() {
    let dir = scene();
    for (name, stage) in [("sky", Stage::Sky), ("embed", Stage::Embed), ("masks", Stage::Masks)] {
        let actors = Simulated { gives_up: vec![(stage, 2)], ..Simulated::default() };
        let summary = run(dir.path(), name, FEATURES, &actors).expect("it runs");
        let skipped = &summary.skipped[0];
        assert_eq!((summary.skipped.len(), &*skipped.reason), (1, &*format!("{stage}: simulated")));
        assert!(skipped.name.contains('2'), "{}", skipped.name);
        assert_eq!(summary.made, 3 * PHOTOS - 1);
        // Without its embedding the field cannot use it.
        let field_of = actors.field_of.lock().expect("no panic").clone();
        assert_eq!(field_of.contains(&2), stage != Stage::Embed, "{name}: {field_of:?}");
    }
}

#[test]
fn a_stage_that_gives_up_every_photo_fails() {
    let dir = scene();
    let gives_up = (0..PHOTOS).map(|view| (Stage::Embed, view)).collect();
    let actors = Simulated { gives_up, ..Simulated::default() };
    let error = run(dir.path(), "run", FEATURES, &actors).expect_err("no photo is left").to_string();
    assert!(error.contains("`embed`") && error.contains("not one of 5 photos"), "{error}");
    let ledger = Ledger::open_read_only(dir.path().join("run/run.sqlite")).expect("its ledger");
    let stages = ledger.stages().expect("its stages");
    let embed = stages.iter().find(|row| row.name == "embed").expect("its row");
    assert_eq!(embed.state, State::Failed);
}

#[test]
fn a_stage_whose_result_is_in_the_cache_does_not_start() {
    let dir = scene();
    run(dir.path(), "run", FEATURES, &Simulated::default()).expect("it runs");
    let again = Simulated { seed: 7, ..Simulated::default() };
    let summary = run(dir.path(), "run", FEATURES, &again).expect("it runs");
    assert_eq!(summary.splats, SPLATS);
    let log = again.log();
    for stage in [Stage::Geometry, Stage::Features] {
        assert!(!log.contains(&Seen::Ordered(stage, None)), "{stage} is in the cache: {log:#?}");
    }
    // Something of the training is kept: its key depends on the skies, so that they come first.
    assert!(last(&log, Stage::Sky) < at(&log, &Seen::Ordered(Stage::Masks, Some(0))), "{log:#?}");
}

#[test]
fn of_more_photos_than_pay_some_have_masks_and_embeddings_and_all_are_trained_on() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    write_scene_of(&dir.path().join("scene"), 24);
    let run_with = |described: DescribedPhotos| {
        let (actors, events) = (Simulated::default(), Events::new());
        let mut settings = settings();
        settings.run.described_photos = described;
        let listener = events.subscribe();
        let options =
            RunOptions { until: Some(FEATURES), events, all_described: 22, ..RunOptions::default() };
        let (scene, folder) = (dir.path().join("scene"), dir.path().join("run"));
        let folder = RunFolder::create(&folder).expect("a folder");
        let summary = run_with_actors(&scene, &folder, &settings, &options, &actors).expect("it runs");
        let mut messages = Vec::new();
        while let Some(event) = listener.try_next() {
            if let Event::Message { message, .. } = event.event {
                messages.push(message);
            }
        }
        let of = |stage: Stage| -> BTreeSet<usize> {
            let ordered = |seen: &Seen| match seen {
                Seen::Ordered(of, Some(view)) if *of == stage => Some(*view),
                _ => None,
            };
            actors.log().iter().filter_map(ordered).collect()
        };
        let field_of: BTreeSet<usize> = actors.field_of.lock().expect("no panic").iter().copied().collect();
        assert_eq!(summary.skipped.len(), 0);
        let ledger = Ledger::open_read_only(dir.path().join("run/run.sqlite")).expect("its ledger");
        let recorded = ["masks", "embed"].map(|stage| ledger.views(stage).expect("its photos").len());
        (of(Stage::Sky).len(), of(Stage::Embed), of(Stage::Masks), field_of, recorded, messages)
    };
    let (skies, embedded, masked, field_of, recorded, messages) = run_with(DescribedPhotos::All);
    assert_eq!((skies, embedded.len(), masked.len(), field_of.len()), (24, 24, 24, 24));
    assert_eq!(recorded, [24, 24]);
    assert!(!messages.iter().any(|message| message.contains("masks and descriptors")), "{messages:#?}");
    // The field of some of them is another one, and the ledger forgets the others: the scene tree is of the masks that it names.
    let (_, embedded, masked, field_of, recorded, messages) = run_with(DescribedPhotos::Auto);
    assert_eq!((embedded.len(), recorded), (22, [22, 22]));
    assert!(embedded == masked && masked == field_of);
    let says = "masks and descriptors are made of 22 of 24 photos: the other 2";
    assert!(messages.iter().any(|message| message.starts_with(says)), "{messages:#?}");
    let intake = String::from_utf8(bytes(dir.path(), "run/scene.json")).expect("text");
    assert!(intake.contains(r#""undescribed": 2"#), "{intake}");
}

#[test]
fn a_run_that_stops_before_the_snapshot_makes_no_masks() {
    let dir = scene();
    let actors = Simulated::default();
    let summary = run(dir.path(), "run", Until::Step(3), &actors).expect("it stops");
    assert_eq!((summary.paused_at, summary.splats), (Some(3), 0));
    let log = actors.log();
    assert!(!log.iter().any(|s| matches!(s, Seen::Ordered(Stage::Masks | Stage::Features, _))), "{log:#?}");
}

#[test]
fn a_run_up_to_the_embeddings_trains_nothing() {
    let dir = scene();
    let actors = Simulated::default();
    run(dir.path(), "run", Until::Stage(Stage::Embed), &actors).expect("it runs");
    let others = |s: &Seen| !matches!(s, Seen::Ordered(Stage::Sky | Stage::Embed, _) | Seen::Answered(..));
    assert!(!actors.log().iter().any(others), "{:#?}", actors.log());
}
