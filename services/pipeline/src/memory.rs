//! How much memory a run will take, before it starts.
//!
//! Nothing in a run grows with the number of photos but indexes (names, keys, cameras, points): photos, embeddings,
//! masks and renders are read when they are needed and pass through bounded mailboxes. What is held is proportional to
//! the splats and to the size of one photo, plus three caches with limits of their own, which shrink to fit the budget.

use crate::{RunError, Settings};
use segwild_scene::Scene;
use segwild_trainer::splat_cap;

/// MiB of the program itself, its threads, SQLite and the report's pictures.
const BASE: f64 = 70.0;
/// Bytes of all indexes per photo: names, keys, cameras, ledger rows, spans of the timeline.
const PER_PHOTO: f64 = 12_000.0;
/// Bytes per observation of a reconstructed point, as read and as the trainer sorts it.
const PER_OBSERVATION: f64 = 60.0;
/// Copies of a splat's parameters while a checkpoint is written: they and Adam's two moments in the trainer, in the
/// checkpoint and in its bytes, gradients, snapshot.
const COPIES: f64 = 12.0;
/// Bytes per splat beside its parameters: projection, statistics.
const PER_SPLAT: f64 = 200.0;
/// Copies of a splat's features: values, Adam's moments, gradients.
const FEATURE_COPIES: f64 = 5.0;
/// Floats per pixel of a photo that all actors together hold at work.
const PER_PIXEL: f64 = 120.0;
/// Least MiB that each of the caches is given.
const LEAST_CACHE: usize = 8;

const MIB: f64 = (1 << 20) as f64;

/// What a run takes, in MiB.
struct Estimate {
    /// Everything but the caches.
    fixed: f64,
}

fn estimate(settings: &Settings, scene: &Scene) -> Estimate {
    let size = settings.scene.size;
    let splats = splat_cap(&settings.train, scene, size) as f64;
    let bands = f64::from((settings.train.sh_degree + 1).pow(2));
    let training = 4.0 * (11.0 + 3.0 * bands) * COPIES + PER_SPLAT;
    let field = 4.0 * f64::from(settings.features.channels) * FEATURE_COPIES + 4.0 * (11.0 + 3.0 * bands);
    let pixels = scene.views.iter().map(|v| {
        let camera = v.camera.scaled_to(size);
        f64::from(camera.width) * f64::from(camera.height)
    });
    let samples = f64::from(settings.features.pca_samples) * 4.0 * 64.0;
    let observations: usize = scene.points.iter().map(|p| p.track.len()).sum();
    let bytes = splats * training.max(field)
        + pixels.fold(0.0, f64::max) * 4.0 * PER_PIXEL
        + samples
        + scene.views.len() as f64 * PER_PHOTO
        + observations as f64 * PER_OBSERVATION;
    Estimate { fixed: BASE + bytes / MIB }
}

/// The settings with caches that fit the memory budget, if there is one.
///
/// # Errors
/// In words, with the numbers, when the rest alone does not fit.
pub(crate) fn within_budget(settings: &Settings, scene: &Scene) -> Result<Settings, RunError> {
    let mut settings = settings.clone();
    let budget = settings.run.memory_budget as usize;
    if budget == 0 {
        return Ok(settings);
    }
    let fixed = estimate(&settings, scene).fixed.ceil() as usize;
    if fixed + 2 * LEAST_CACHE > budget {
        let splats = splat_cap(&settings.train, scene, settings.scene.size);
        return Err(RunError::Request(format!(
            "this run needs about {} MiB of memory for {splats} splats and photos of {} px, and --memory-budget allows \
             {budget}: give more, or lower --splats or --size",
            fixed + 2 * LEAST_CACHE,
            settings.scene.size
        )));
    }
    // Photos' analyses are held to the end. Of the other two the trainer's photos go before the field is made.
    let spare = budget - fixed;
    settings.vision.vision_memory = settings.vision.vision_memory.min((spare / 2) as u32);
    let rest = spare - settings.vision.vision_memory as usize;
    settings.train.photo_cache_mib = settings.train.photo_cache_mib.min(rest);
    settings.features.feature_memory = settings.features.feature_memory.min(rest as u32);
    Ok(settings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Frame;

    #[test]
    fn a_budget_is_shared_by_every_cache_that_is_held_at_the_same_time() {
        let frame = Frame { origin: Default::default(), scale: 1.0 };
        let scene = Scene { views: Vec::new(), points: Vec::new(), skipped: Vec::new(), frame };
        let mut settings = Settings::default();
        settings.train.splats = 1000;
        let fixed = estimate(&settings, &scene).fixed.ceil() as usize;
        settings.run.memory_budget = (fixed + 40) as u32;
        let fitted = within_budget(&settings, &scene).expect("it fits");
        let vision = fitted.vision.vision_memory as usize;
        for other in [fitted.train.photo_cache_mib, fitted.features.feature_memory as usize] {
            assert!(
                vision >= LEAST_CACHE && other >= LEAST_CACHE && vision + other <= 40,
                "{vision} {other}"
            );
        }
        settings.run.memory_budget = (fixed + LEAST_CACHE) as u32;
        assert!(within_budget(&settings, &scene).is_err());
    }
}
