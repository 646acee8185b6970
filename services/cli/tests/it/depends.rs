//! What depends on which setting: a changed one has exactly those stages done again, and what is not done again is what
//! would have come of it.

use crate::common::*;
use segwild_pipeline::{RunFolder, Settings, Stage, StageVerdict, explain};
use std::collections::BTreeMap;
use std::path::Path;

const GEOMETRY: &[&str] = &["masks", "geometry", "features", "evaluate", "objects"];
const SNAPSHOT: &[&str] = &["masks", "geometry", "features"];
const MASKS: &[&str] = &["masks", "features"];
const FEATURES: &[&str] = &["features"];
const NOTHING: &[&str] = &[];

/// Every setting of the groups `train`, `masks` and `features`: another value, and the stages that depend on it where
/// the others have their defaults.
const TABLE: [(&str, &str, &[&str]); 56] = [
    ("steps", "61", GEOMETRY),
    // The run says how many steps: nothing is left to the scene.
    ("effort", "2", &[]),
    ("splats", "500", GEOMETRY),
    ("density", "mcmc", GEOMETRY),
    ("sh_degree", "1", GEOMETRY),
    ("appearance_model", "none", GEOMETRY),
    ("robust", "false", GEOMETRY),
    ("robust_share", "0.1", GEOMETRY),
    ("cross_checks", "3", GEOMETRY),
    ("refine_poses", "false", GEOMETRY),
    ("stereo", "0.5", GEOMETRY),
    ("seed", "2", GEOMETRY),
    ("lr_mean", "0.4", GEOMETRY),
    ("lr_opacity", "0.04", GEOMETRY),
    ("lr_scale", "0.02", GEOMETRY),
    ("lr_rotation", "0.004", GEOMETRY),
    ("lr_colour", "0.004", GEOMETRY),
    ("lr_appearance", "0.001", GEOMETRY),
    // Without the appearance model `embed`, splats keep no code.
    ("lr_splat_embedding", "0.02", NOTHING),
    ("splat_embedding_from", "0.2", NOTHING),
    // Only the appearance model `gsw` has networks.
    ("lr_net", "0.5", NOTHING),
    ("gsw_width", "paper", NOTHING),
    ("lambda_ssim", "0.4", GEOMETRY),
    ("lambda_lpips", "0.005", GEOMETRY),
    ("sky_weight", "0.4", GEOMETRY),
    ("coarse", "0.4", GEOMETRY),
    ("antialias", "false", GEOMETRY),
    ("grow_gain", "0.02", GEOMETRY),
    // The trained scene does not depend on where its snapshot is taken.
    ("snapshot_at", "0.4", SNAPSHOT),
    ("blocks", "2", GEOMETRY),
    ("photo_cache_mib", "7", NOTHING),
    ("sasm", "false", MASKS),
    ("prompt_budget", "12", MASKS),
    ("max_points_per_cell", "10", MASKS),
    ("sky_prompts", "false", MASKS),
    ("mask_source", "photo", MASKS),
    ("prompt_batch", "128", MASKS),
    ("min_predicted_iou", "0.8", MASKS),
    ("min_stability", "0.9", MASKS),
    ("min_masks", "12", MASKS),
    ("mask_nms", "0.6", MASKS),
    ("min_mask_area", "0.001", MASKS),
    ("channels", "16", FEATURES),
    ("compression", "learned", FEATURES),
    ("keep_variance", "0.9", FEATURES),
    ("pca_samples", "40000", FEATURES),
    ("feature_size", "64", FEATURES),
    ("refine_steps", "5", FEATURES),
    ("pixels_per_step", "512", FEATURES),
    ("weight_embedding", "0.6", FEATURES),
    ("weight_compact", "0.2", FEATURES),
    ("compactness", "false", FEATURES),
    ("feature_lr", "0.002", FEATURES),
    // There is no learned decoder.
    ("decoder_lr", "0.001", NOTHING),
    ("feature_seed", "1", FEATURES),
    ("feature_memory", "7", NOTHING),
];

/// The same where there is a learned decoder, and light of its own on each splat, and no masks have a part in the field.
fn otherwise(name: &str, stages: &'static [&'static str]) -> &'static [&'static str] {
    match name {
        "lr_splat_embedding" | "splat_embedding_from" => GEOMETRY,
        "snapshot_at" => &["masks", "geometry"],
        "weight_compact" => NOTHING,
        "decoder_lr" => FEATURES,
        _ if stages == MASKS => &["masks"],
        _ => stages,
    }
}

const OTHERWISE: [&str; 6] =
    ["--appearance-model", "embed", "--compactness", "false", "--compression", "learned"];

/// The stages that a run with these settings would do again; the report is written by every run.
fn done_again(run: &Path, settings: &Settings) -> Vec<&'static str> {
    let plans =
        explain(&shared_run().scene, &RunFolder::at(run), settings, None).expect("it can be explained");
    let again =
        plans.into_iter().filter(|plan| plan.verdict != StageVerdict::Reused && plan.stage != Stage::Report);
    again.map(|plan| plan.stage.name()).collect()
}

fn settings_of(run: &Path) -> Settings {
    Settings::layered(Some(&run.join("segwild.toml")), &[]).expect("its settings")
}

#[test]
fn a_changed_setting_has_exactly_those_stages_done_again_that_depend_on_it() {
    let catalogue = Settings::catalogue();
    let groups = catalogue.iter().filter(|(table, ..)| ["train", "masks", "features"].contains(table));
    let names: Vec<&str> = groups.flat_map(|(_, _, fields)| fields.iter().map(|f| f.name)).collect();
    let known: BTreeMap<&str, _> =
        TABLE.iter().map(|(name, value, stages)| (*name, (value, stages))).collect();
    let dir = folder();
    let other = copied_run(&dir);
    completes(&again(&other, &OTHERWISE));
    let mut wrong = Vec::new();
    for name in names {
        let (value, stages) = known.get(name).unwrap_or_else(|| panic!("`{name}` is not in the table"));
        for (run, expected) in [(&shared_run().run, **stages), (&other, otherwise(name, stages))] {
            let mut settings = settings_of(run);
            // What is so already has to be changed the other way.
            let value = match (name, settings.get(name)) {
                ("compactness", Some(now)) if now == "false" => "true",
                ("compression", Some(now)) if now == "learned" => "pca",
                _ => value,
            };
            let expected = if name == "compactness" { FEATURES } else { expected };
            settings.set(name, value).expect("a value that fits");
            let found = done_again(run, &settings);
            if found != expected {
                wrong.push(format!("{name}: {found:?} instead of {expected:?}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn another_step_for_the_snapshot_leaves_the_trained_scene_alone() {
    let dir = folder();
    let at = ["--snapshot-at", "0.4"];
    let straight = dir.path().join("straight");
    completes(&again(&straight, &at));
    let file = |run: &Path, name: &str| std::fs::read(run.join(name)).expect("it is there");
    assert!(file(&straight, "model.bin") == file(&shared_run().run, "model.bin"));
    assert!(
        file(&straight, "features.bin") != file(&shared_run().run, "features.bin"),
        "its masks are others"
    );

    // A finished run trains again up to the snapshot, and no further.
    let run = copied_run(&dir);
    let before = file(&run, "model.bin");
    let explained = again(&run, &[&at[..], &["--explain"]].concat());
    let (plan, _) = completes(&explained);
    assert!(plan.contains("again from step 0 to 24") && plan.contains("snapshot_at: 0.5 -> 0.4"), "{plan}");
    completes(&again(&run, &at));
    assert!(file(&run, "model.bin") == before);
    has_all_of(&run, &results(&straight));
    completes(&again(&run, &["--snapshot-at", "0.5"]));
    has_what_an_untouched_run_has(&run);

    // One that stands past the new position goes by it again.
    let paused = dir.path().join("paused");
    completes(&again(&paused, &["--until", "40"]));
    completes(&again(&paused, &at));
    has_all_of(&paused, &results(&straight));
}

#[test]
fn a_field_without_compactness_does_not_depend_on_masks_nor_on_a_decoder_that_there_is_not() {
    let dir = folder();
    let (run, other) = (copied_run(&dir), dir.path().join("other"));
    completes(&again(&run, &["--compactness", "false"]));
    let more = ["--compactness", "false", "--prompt-budget", "12", "--decoder-lr", "0.01"];
    completes(&again(&other, &more));
    let field = |run: &Path| std::fs::read(run.join("features.bin")).expect("it is there");
    assert!(field(&run) == field(&other));
    let (_, stderr) = completes(&again(&run, &more));
    assert!(stderr.contains("features was done before") && stderr.contains("masks done"), "{stderr}");
}
