//! NeRF-W's controlled experiment: the same photos clean, in other colours, with a striped square before them, and both;
//! what each costs on clean test photos (method, section 11).

use super::base::{OnRecord, ProtocolBase, keep};
use super::error::ProtocolError;
use crate::ablation::{FULL, Variant};
use crate::oracle::OracleOptions;
use crate::perturb::{AffineColours, StripedSquare};
use crate::record::{Record, Results};
use crate::trial::{ProviderKind, Trial, TrialError};
use segwild_synthetic::{LightVariation, SyntheticOptions, SyntheticScene, generate};
use std::collections::BTreeMap;
use std::path::Path;

/// What is done to the training photos.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Perturbation {
    /// Nothing.
    Clean,
    /// Each photo has colours of its own.
    Colour,
    /// Each photo has a striped square somewhere.
    Occluders,
    /// Both.
    Both,
}

impl Perturbation {
    /// All, the clean one first.
    pub const ALL: [Perturbation; 4] =
        [Perturbation::Clean, Perturbation::Colour, Perturbation::Occluders, Perturbation::Both];

    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Perturbation::Clean => "clean",
            Perturbation::Colour => "colour",
            Perturbation::Occluders => "occluders",
            Perturbation::Both => "both",
        }
    }

    /// Does it to the training photos of a scene.
    ///
    /// # Errors
    /// When a photo is too small for the square.
    pub fn apply(self, scene: &mut SyntheticScene) -> Result<(), ProtocolError> {
        let seed = scene.options.seed;
        for (i, photo) in scene.photos.iter_mut().enumerate().filter(|(_, p)| !p.test) {
            if matches!(self, Perturbation::Colour | Perturbation::Both) {
                photo.photo = AffineColours::random(seed, i as u64).apply(&photo.photo)?;
            }
            if matches!(self, Perturbation::Occluders | Perturbation::Both) {
                let square = StripedSquare::random(seed, i as u64, photo.photo.width, photo.photo.height)?;
                (photo.photo, photo.transients) = square.apply(&photo.photo)?;
            }
        }
        Ok(())
    }
}

/// The rows: what differs between the methods is how they take light and transients.
pub const ROWS: &[Variant] = &[
    FULL,
    Variant {
        name: PLAIN,
        meaning: "plain splatting: one light, nobody left out",
        common: &[("appearance_model", "none"), ("robust", "false")],
        changes: &[],
    },
    Variant { name: "no-robust", meaning: "nobody left out", common: &[("robust", "false")], changes: &[] },
    Variant {
        name: "embed",
        meaning: "the appearance model `embed`",
        common: &[("appearance_model", "embed")],
        changes: &[],
    },
    Variant {
        name: TRUE_TRANSIENTS,
        meaning: "exactly the transients left out, as the truth has them: what leaving out can be worth",
        common: &[],
        changes: &[],
    },
];

/// The row that gets the true transient masks.
const TRUE_TRANSIENTS: &str = "true-transients";
/// The row that others are compared with.
pub(super) const PLAIN: &str = "plain";

/// What is measured.
#[derive(Clone, Debug)]
pub struct LegoProtocol {
    /// Rows to compute; all if empty.
    pub only: Vec<String>,
    /// Seeds of the scenes.
    pub seeds: Vec<u64>,
    /// The scenes, but for their seeds, appearances and transients, of which they have none.
    pub scene: SyntheticOptions,
    /// The provider of masks and descriptors.
    pub providers: ProviderKind,
    /// What all rows have in common.
    pub base: ProtocolBase,
}

/// Measures PSNR and SSIM of the clean test photos for every row and perturbation, and the gap to the clean run. Rows
/// with an appearance model have it fitted on the left half of a test photo and are scored on the right half, as always; a gap
/// compares a row with itself.
pub fn lego(
    out: &Path,
    options: &LegoProtocol,
    results: &mut Results,
    report: OnRecord,
) -> Result<(), ProtocolError> {
    let only = &options.only;
    if let Some(odd) = only.iter().find(|o| ROWS.iter().all(|r| r.name != **o)) {
        return Err(TrialError::no_row(odd, ROWS.iter().map(|row| row.name)).into());
    }
    for &seed in &options.seeds {
        let scene = SyntheticOptions {
            seed,
            occlusion: 0.0,
            photo_light: LightVariation::None,
            ..options.scene.clone()
        };
        let clean = generate(&scene)?;
        let mut best: BTreeMap<&str, f64> = BTreeMap::new();
        for perturbation in Perturbation::ALL {
            let mut scene = clean.clone();
            perturbation.apply(&mut scene)?;
            let dir = out.join(format!("lego-{seed}-{}", perturbation.name()));
            let trial = Trial::of(&dir, scene, options.providers, &OracleOptions::default())?;
            for row in ROWS.iter().filter(|r| only.is_empty() || only.iter().any(|o| o == r.name)) {
                let mut settings = options.base.row(row)?;
                // Renders are scored, not objects: no time is spent on features.
                (settings.features.refine_steps, settings.masks.prompt_budget) = (0, 1);
                if row.name == TRUE_TRANSIENTS {
                    let truth = trial.scene_dir().join("truth/transient");
                    settings.scene.transient_masks = truth.display().to_string();
                }
                let Some(held) = trial.held_out(&settings)? else { continue };
                let psnr = f64::from(held.psnr);
                let gap = best.entry(row.name).or_insert(psnr).to_owned() - psnr;
                let mut numbers: BTreeMap<String, f64> = held.numbers().into_iter().collect();
                numbers.insert("gap_db".into(), gap);
                let record = Record {
                    protocol: "lego".into(),
                    scene: format!("seed {seed}"),
                    setting: row.name.into(),
                    provider: trial.providers(&settings)?.name,
                    target: perturbation.name().into(),
                    seed,
                    numbers,
                    notes: vec![held.protocol],
                    ..Record::default()
                };
                keep(results, record, out, report)?;
            }
        }
    }
    Ok(())
}
