//! Choice of the appearance model of a scene: a guess from its points before any training, then short fits that are scored
//! on photos held out of them (method, section 9).

use super::tracks::{Tracks, tracks};
use super::{ShortFit, Trials};
use crate::settings::one_light_steps;
use crate::{AppearanceModel, Photos, TrainError, TrainSettings};
use segwild_objective::Engine;
use segwild_scene::Scene;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The appearance models that are tried, cheapest first. `gsw` is not among them: on `liberty` it is worth .15 dB over
/// `embed` at three times the step (docs/experiments/2026-11-21-appearance-models-on-held-out-photos.md).
pub const APPEARANCE_MODELS: [AppearanceModel; 3] =
    [AppearanceModel::None, AppearanceModel::Affine, AppearanceModel::Embed];

/// What a dearer appearance model must gain on the photos held out, in dB.
const WORTH: f32 = 0.15;
/// Share of the points' colour variance that an affine appearance must explain for photos to count as different in light.
const DIFFERS: f32 = 0.3;
/// Photos are of one light where it differs by less ([`Tracks::light`]): seven captured scenes have .003 to .030, three of
/// tourists' photos .045 to .093. A captured scene needs no appearance model: a matrix per photo explains noise and shine
/// there, and whole photos held out lose .1 to 3.5 dB by it on six of the seven (docs/experiments/2026-11-27-one-light-and-no-transients.md).
const ONE_LIGHT: f32 = 0.036;
/// Long side of the photos of the tracks and the short fits, in pixels at most.
pub const SIZE: u32 = 160;
/// Steps of a short fit: a share of the whole training's, within these.
const STEPS: (u32, u32) = (300, 600);

/// Photos agree where those held out of the appearance model's fit are rendered with so many dB: `desk` and `fern` have 30
/// and 29, scenes that differ in light or are crowded 14 to 22.
const AGREE: f32 = 25.0;

/// The appearance model chosen for a scene, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AppearanceChoice {
    /// The appearance model.
    pub appearance: AppearanceModel,
    /// Why, in a sentence.
    pub why: String,
    /// Colour differences of the points between photos; `None` where too few points were seen by several photos.
    pub tracks: Option<Tracks>,
    /// The fits that were tried, in the order in which they were.
    pub fits: Vec<ShortFit>,
    /// Photos that these were scored on.
    pub held_out: usize,
}

impl AppearanceChoice {
    /// The steps of the training, from those decided without the choice.
    pub fn steps(&self, decided: u32) -> u32 {
        if self.appearance == AppearanceModel::None { one_light_steps(decided) } else { decided }
    }

    /// Whether the photos agree about the scene, by the scores of the fits.
    pub fn agrees(&self) -> bool {
        self.fits.iter().any(|fit| fit.appearance == self.appearance && fit.psnr >= AGREE)
    }
}

/// Chooses the simplest appearance model that suffices. `photos` gives photos of a long side of [`SIZE`] at most; `stopping`
/// ends the work. The same scene, photos and settings give the same choice. With `agreement` there is at least one fit, for
/// [`AppearanceChoice::agrees`].
pub fn choose_appearance(
    engine: Arc<dyn Engine>,
    scene: &Scene,
    photos: Arc<dyn Photos>,
    settings: &TrainSettings,
    agreement: bool,
    stopping: &dyn Fn() -> bool,
) -> Result<AppearanceChoice, TrainError> {
    let settings = &settings.decided(scene);
    let mut trials = Trials::new(engine, scene, photos.clone(), stopping);
    let tracks = tracks(scene, &*photos, &trials.usable);
    let one_light = tracks.is_some_and(|t| t.light() < ONE_LIGHT);
    let guess = match tracks {
        Some(tracks) if !one_light && tracks.explained() >= DIFFERS => 1,
        _ => 0,
    };
    let evidence = tracks.map_or("no points that several photos saw".to_owned(), |t| {
        let of_one_light = if one_light { ": they are of one light" } else { "" };
        format!(
            "the colours of {} points differ by {:.3} between photos, and by {:.3} after a colour matrix per photo{of_one_light}",
            t.points, t.raw, t.after_affine
        )
    });
    if scene.imported.is_some() {
        // A matrix for each photo is fitted to the splats as they are: no fit of them says whether it pays.
        let appearance = if one_light { AppearanceModel::None } else { AppearanceModel::Affine };
        let why = format!("{appearance}: {evidence}; imported splats take none or affine");
        return Ok(AppearanceChoice { appearance, why, tracks, fits: Vec::new(), held_out: 0 });
    }
    if trials.held_out.is_empty() {
        let appearance = APPEARANCE_MODELS[guess];
        let why =
            format!("{appearance}: {evidence}; {} photos are too few to hold any out", trials.usable.len());
        return Ok(AppearanceChoice { appearance, why, tracks, fits: Vec::new(), held_out: 0 });
    }
    let steps = (settings.steps / 8).clamp(STEPS.0, STEPS.1);
    let fit = |trials: &mut Trials, appearance| -> Result<(), TrainError> {
        if trials.fits.iter().all(|fit| fit.appearance != appearance) {
            trials.fit(TrainSettings { appearance_model: appearance, steps, ..settings.clone() })?;
        }
        Ok(())
    };
    if one_light && agreement {
        // Halves cannot compare models here: a matrix fitted to the left half also explains shine and vignetting of the right
        // one. The single fit tells how well the photos agree.
        fit(&mut trials, APPEARANCE_MODELS[guess])?;
    }
    let mut pays = |dearer: usize| -> Result<bool, TrainError> {
        let appearances = [dearer - 1, dearer].map(|index| APPEARANCE_MODELS[index]);
        for appearance in appearances {
            fit(&mut trials, appearance)?;
        }
        // Scores change with every further fit: they are compared when both are there.
        let psnr = appearances.map(|appearance| {
            trials.fits.iter().find(|fit| fit.appearance == appearance).map_or(0.0, |fit| fit.psnr)
        });
        Ok(psnr[1] - psnr[0] >= WORTH)
    };
    let mut chosen = guess;
    // To dearer models while that pays. None cheaper than the points call for: fits of noise and transients came out the same
    // for all models on a synthetic scene of many lights, and without one the training lost .7 dB.
    while !one_light && chosen + 1 < APPEARANCE_MODELS.len() && pays(chosen + 1)? {
        chosen += 1;
    }
    let (held_out, fits) = (trials.held_out.len(), trials.fits);
    let appearance = APPEARANCE_MODELS[chosen];
    let scores: Vec<String> =
        fits.iter().map(|fit| format!("{} {:.2} dB", fit.appearance, fit.psnr)).collect();
    let compared = match scores.join(", ") {
        none if none.is_empty() => String::new(),
        scores => format!("; on {held_out} photos held out of fits of {steps} steps: {scores}"),
    };
    let why = format!("{appearance}: {evidence}{compared}");
    Ok(AppearanceChoice { appearance, why, tracks, fits, held_out })
}
