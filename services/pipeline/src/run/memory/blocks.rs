//! In how many blocks a scene is trained, where the memory budget decides.

use super::{MemoryNeed, fits, need};
use crate::{RunError, Settings};
use segwild_scene::Scene;
use std::path::Path;

/// Numbers of blocks that are tried where the memory budget decides. More hardly take less memory: all splats are
/// rendered.
const BLOCKS: [usize; 5] = [2, 4, 8, 16, 32];

impl MemoryNeed {
    /// What a run of the scene in folder `scene` would take: by blocks, where the settings leave their number open and the
    /// whole scene does not fit in `budget` MiB. Reads its cameras and points and the heads of its photos.
    ///
    /// # Errors
    /// When the scene cannot be opened.
    pub fn within(budget: u32, scene: &Path, settings: &Settings) -> Result<MemoryNeed, RunError> {
        let mut settings = settings.anchored();
        let scene = Scene::open(scene, &settings.scene)?;
        settings.run.memory_budget = budget;
        Ok(need(&with_blocks(&settings, &scene, None), &scene))
    }
}

/// The settings with the number of blocks that the scene is trained in, where it is left open: that of the training in
/// the run folder (`recorded`), as long as such a training fits in the memory budget, whatever is made from the trained
/// scene. Otherwise one, or as many as the memory budget needs. One where no number of them fits: [`super::within_budget`]
/// refuses that.
pub(crate) fn with_blocks(settings: &Settings, scene: &Scene, recorded: Option<usize>) -> Settings {
    let of = |blocks: usize| {
        let mut settings = settings.clone();
        settings.train.blocks = blocks;
        settings
    };
    if scene.imported.is_some() {
        return of(1);
    }
    match (settings.train.blocks, recorded) {
        (0, Some(blocks)) if fits(&training_alone(&of(blocks)), scene) => of(blocks),
        (0, _) if fits(&of(1), scene) => of(1),
        (0, _) => BLOCKS.into_iter().map(of).find(|divided| fits(divided, scene)).unwrap_or_else(|| of(1)),
        (blocks, _) => of(blocks),
    }
}

/// The settings without what takes memory after the training alone.
fn training_alone(settings: &Settings) -> Settings {
    let mut settings = settings.clone();
    (settings.features.channels, settings.features.pca_samples) = (0, 0);
    if settings.train.lambda_lpips == 0.0 {
        settings.run.lpips_weights.clear();
    }
    settings
}

/// What was decided about the blocks, in words; `None` where the scene is trained as a whole, as scenes usually are.
pub(crate) fn blocks_in_words(recorded: Option<usize>, blocks: usize) -> Option<String> {
    let by = |blocks: usize| match blocks {
        1 => "as a whole".to_owned(),
        blocks => format!("in {blocks} blocks"),
    };
    match recorded {
        Some(before) if before != blocks => Some(format!(
            "the scene was trained {}, which does not fit in --memory-budget: it is trained {} now",
            by(before),
            by(blocks)
        )),
        Some(_) if blocks > 1 => Some(format!("the scene stays trained {}", by(blocks))),
        None if blocks > 1 => Some(format!(
            "the training does not fit in --memory-budget as a whole: the scene is trained {}",
            by(blocks)
        )),
        Some(_) | None => None,
    }
}

#[cfg(test)]
mod tests {
    use super::super::within_budget;
    use super::*;
    use glam::Vec3;
    use segwild_scene::{Camera, Photo, Pose, View};

    /// Cameras in a row.
    fn row() -> Scene {
        let view = |i: usize| View {
            name: format!("{i}.jpg"),
            camera: Camera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 },
            pose: Pose::look_at(Vec3::X * i as f32, Vec3::X * i as f32 + Vec3::Z, Vec3::NEG_Y),
            photo: Photo::new("none"),
            test: false,
        };
        Scene::new((0..200).map(view).collect(), vec![])
    }

    #[test]
    fn a_budget_that_is_too_small_for_the_whole_scene_divides_it_into_as_few_blocks_as_fit() {
        let row = row();
        let mut settings = Settings::default();
        settings.train.splats = 400_000;
        let least = |settings: &Settings| need(settings, &row).least_mib;
        let whole = least(&settings);
        assert_eq!(with_blocks(&settings, &row, None).train.blocks, 1, "no budget");
        let mut before = 1;
        for share in [1.0, 0.9, 0.75, 0.6] {
            settings.run.memory_budget = (f64::from(whole) * share) as u32;
            let fitted = with_blocks(&settings, &row, None);
            assert!(fitted.train.blocks >= before, "{share}: {}", fitted.train.blocks);
            assert!(least(&fitted) <= settings.run.memory_budget, "{share}");
            within_budget(&fitted, &row).expect("it fits");
            let mut fewer = fitted.clone();
            fewer.train.blocks = (fitted.train.blocks / 2).max(1);
            let is_least = fitted.train.blocks == 1 || least(&fewer) > settings.run.memory_budget;
            assert!(is_least, "{share}: {} blocks do as well", fewer.train.blocks);
            before = fitted.train.blocks;
        }
        assert!(before > 1);
        settings.run.memory_budget = whole / 4;
        let divided = with_blocks(&settings, &row, None);
        let refused = within_budget(&divided, &row).expect_err("all is rendered at once");
        assert!(refused.to_string().contains(&format!("{whole} MiB")), "{refused}");
        settings.train.blocks = 3;
        assert_eq!(with_blocks(&settings, &row, Some(2)).train.blocks, 3, "a given number stays");
        segwild_scene::limit_decoding(None);
    }

    #[test]
    fn a_trained_scene_keeps_its_blocks_while_the_training_fits() {
        let row = row();
        let mut settings = Settings::default();
        settings.train.splats = 400_000;
        let whole = need(&settings, &row).least_mib;
        settings.run.memory_budget = whole;
        let blocks = |settings: &Settings, recorded| with_blocks(settings, &row, recorded).train.blocks;
        assert_eq!((blocks(&settings, None), blocks(&settings, Some(4))), (1, 4));
        // A field that takes more than the budget divides no scene that is trained as a whole, and refuses its own run.
        let mut more = settings.clone();
        more.features.pca_samples += 50 * 4096;
        assert!(blocks(&more, None) > 1 && blocks(&more, Some(1)) == 1);
        within_budget(&with_blocks(&more, &row, Some(1)), &row).expect_err("its features do not fit");
        // A training that does not fit is divided again, and both numbers are named.
        settings.run.memory_budget = (f64::from(whole) * 0.75) as u32;
        let now = blocks(&settings, Some(1));
        assert!(now > 1 && blocks(&settings, None) == now);
        let words = blocks_in_words(Some(1), now).expect("it is trained again");
        assert!(words.contains("as a whole") && words.contains(&format!("in {now} blocks")), "{words}");
        assert_eq!((blocks_in_words(None, 1), blocks_in_words(Some(1), 1)), (None, None));
        segwild_scene::limit_decoding(None);
    }
}
