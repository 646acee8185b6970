//! Other methods as settings of this program, not those methods' programs, so that they are compared on the same photos,
//! geometry engine, 2D models and clicks (paper, Table 1).
//!
//! A row takes over what a method adds to splatting: which photos' differences it explains, what its features learn,
//! and how clicks become a selection. It does not take over what all methods have in common and we do better or worse
//! (density control, schedules). Rows that the literature trains on plain splats stand here twice: on plain splats, as
//! published, and on ours (`-wild`), so that the two causes can be separated.
//!
//! Thresholds are those that served each baseline best where they were tuned, by the oracle's masks: `tau` of .5, .7, .8, .9,
//! .95 and .98 on seed 3 (`segwild bench synthetic --providers oracle --seeds 3 --photo-count 24 --pixels 240 --embedding-similarity 0.97 --only
//! feature-3dgs,saga --change tau=..`): IoU .08, .30, .39, .23, .16, .07 of Feature 3DGS and .23, .53, .43, .24, .16, .07 of SAGA. `rho` of .3, .5 and .7 there, the
//! bias of FlashSplat's closed form: .769, .775, .753; the minimum cut does not ask for it (.809).
//! The built-in embedder's features spread wider than the oracle's: on photos both want less (`--change tau=0.3`; tuned on
//! one photo of `liberty`, .80 and .90 at .5, .90 and .90 at .3, .92 and .90 at 0 of SAGA and Feature 3DGS). More steps for
//! the features than the default's serve neither (`--change refine-steps=300`: .71 and .70 for .75 and .72).

use crate::ablation::{AS_PUBLISHED, Changes, FULL, Variant};

/// Plain splatting: one light for all photos, nobody left out, no sky.
pub const PLAIN: Changes = &[("appearance_model", "none"), ("robust", "false"), ("sky", "none")];

const fn baseline(name: &'static str, meaning: &'static str, common: Changes, changes: Changes) -> Variant {
    Variant { name, meaning, common, changes }
}

/// Feature 3DGS (Zhou et al. 2024): features learned by rendering them, without compactness; every splat whose feature
/// resembles the click's is selected. No mask takes part.
const FEATURE_3DGS: Changes = &[
    ("compactness", "false"),
    ("similarity_use", "alone"),
    ("tau", "0.8"),
    ("components", "all"),
    ("spikes", "off"),
];

/// SAGA (Cen et al. 2025): masks on a uniform grid of the photos pull features together; every splat that resembles the
/// click is selected, of which what hangs together with it stays.
const SAGA: Changes = &[
    ("compactness", "true"),
    ("sasm", "false"),
    ("sky_prompts", "false"),
    ("mask_source", "photo"),
    ("similarity_use", "alone"),
    ("tau", "0.7"),
    ("components", "clicked"),
    ("spikes", "off"),
];

/// GS-W (Zhang et al. 2024) with the clicked photo's mask projected: every splat whose centre lies in it is selected.
const PROJECTION: Changes = &[
    ("first_answer", "photo"),
    ("propagate", "0"),
    ("evidence_mode", "centre"),
    ("similarity_use", "off"),
    ("undecided", "out"),
    ("components", "all"),
    ("spikes", "off"),
];

/// FlashSplat (Shen et al. 2024): the labels that fit the masks best, in closed form: light inside against light outside.
const FLASHSPLAT: Changes = &[
    ("first_answer", "photo"),
    ("vote", "light"),
    ("least_evidence", "0"),
    ("undecided", "out"),
    ("similarity_use", "off"),
    ("components", "all"),
    ("spikes", "off"),
];

/// GaussianCut (Jain et al. 2024): masks of many photos as weights, smoothed by a minimum cut over neighbours.
const GRAPH_CUT: Changes = &[
    ("first_answer", "photo"),
    ("similarity_use", "off"),
    ("graph_cut", "true"),
    ("components", "all"),
    ("spikes", "off"),
];

/// The rows.
pub const BASELINES: &[Variant] = &[
    baseline("feature-3dgs", "Feature 3DGS: resemblance alone, on plain splats", PLAIN, FEATURE_3DGS),
    baseline("feature-3dgs-wild", "the same on our splats", FEATURE_3DGS, &[]),
    baseline("saga", "SAGA: compact features, resemblance alone, on plain splats", PLAIN, SAGA),
    baseline("saga-wild", "the same on our splats", SAGA, &[]),
    baseline("gs-w", "GS-W and projection: centres in the clicked photo's mask", PROJECTION, &[]),
    baseline(
        "flashsplat-one",
        "FlashSplat: the clicked photo's mask lifted",
        FLASHSPLAT,
        &[("propagate", "0")],
    ),
    baseline("flashsplat", "FlashSplat: masks carried to all photos and lifted", FLASHSPLAT, &[]),
    baseline("graph-cut-one", "minimum cut, the clicked photo's mask", GRAPH_CUT, &[("propagate", "0")]),
    baseline("graph-cut", "minimum cut, masks carried to all photos", GRAPH_CUT, &[]),
    AS_PUBLISHED,
    FULL,
];

/// The methods that rows are named after, and what their names start with.
const NAMED_AFTER: [(&str, &str); 6] = [
    ("feature-3dgs", "Feature 3DGS"),
    ("saga", "SAGA"),
    ("gs-w", "GS-W"),
    ("flashsplat", "FlashSplat"),
    ("graph-cut", "GaussianCut (minimum cut)"),
    ("paper", "Seg-Wild's paper"),
];

/// The methods that some rows are named after. Such a row is a setting of this program, not that method's program.
pub fn named_after(rows: &[&str]) -> Vec<&'static str> {
    let bears = |prefix: &str| rows.iter().any(|row| row.split('-').next() == prefix.split('-').next());
    NAMED_AFTER.into_iter().filter(|(prefix, _)| bears(prefix)).map(|(_, name)| name).collect()
}

/// The row of that name, here or in the ablation.
pub fn row(name: &str) -> Option<&'static Variant> {
    BASELINES.iter().chain(crate::ablation::VARIANTS).find(|v| v.name == name)
}
