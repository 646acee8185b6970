//! The splat budget: how many splats a training may have.

use crate::{AppearanceModel, TrainSettings};
use segwild_scene::Scene;
use wincode::{SchemaRead, SchemaWrite};

/// Splats for the square root of what pixels the photos have together. A splat needs some pixels in several photos to
/// be determined; photos of one scene overlap, and finer ones show the same surfaces again (docs/experiments/2026-11-22-how-many-splats.md).
const DENSITY: f32 = 16.0;
/// The same where photos are of one light: an appearance explains nothing of what they show
/// (docs/experiments/2026-11-27-transients-by-evidence.md).
const ONE_LIGHT_DENSITY: f32 = 20.0;
/// Fewest and most that a scene is given, whatever its photos.
const BOUNDS: (f32, f32) = (2_000.0, 200_000.0);
/// At least as many as there are points, up to here: each is on a surface that was seen.
const POINTS: usize = 20_000;

/// The splat budget: as many as the photos can determine, less the share of the sky, which needs none.
#[derive(Clone, Copy, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct SplatBudget {
    /// Fewest, even if all is sky.
    least: u64,
    /// Most, if nothing is.
    most: u64,
    /// Sum of the shares that are no sky, over the photos added so far, and their number.
    ground: (f32, u32),
}

impl SplatBudget {
    /// For photos of so many pixels each; or the number of the settings, if it is given there.
    pub fn new(settings: &TrainSettings, points: usize, photos: usize, pixels: usize) -> SplatBudget {
        let (least, most) = match settings.splats {
            0 => {
                let density = match settings.appearance_model {
                    // Whichever is chosen later.
                    AppearanceModel::None | AppearanceModel::Auto => ONE_LIGHT_DENSITY,
                    _ => DENSITY,
                };
                let supported = density * (pixels as f32 * photos as f32).sqrt();
                let least = points.clamp(BOUNDS.0 as usize, POINTS);
                (least, (supported.clamp(BOUNDS.0, BOUNDS.1) as usize).max(least))
            }
            splats => (splats, splats),
        };
        SplatBudget { least: least as u64, most: most as u64, ground: (0.0, 0) }
    }

    /// Adds a photo of which this share is no sky.
    pub fn add_photo(&mut self, ground: f32) {
        self.ground = (self.ground.0 + ground, self.ground.1 + 1);
    }

    /// Most splats, by the photos added so far.
    pub fn splats(&self) -> usize {
        let (sum, photos) = self.ground;
        let share = if photos > 0 { sum / photos as f32 } else { 1.0 };
        ((self.most as f32 * share) as u64).clamp(self.least, self.most) as usize
    }
}

/// Most splats that a training on this scene may come to at the size photos are trained at (long side): where they show
/// sky, it comes to fewer.
pub fn splat_cap(settings: &TrainSettings, scene: &Scene, long_side: u32) -> usize {
    let train: Vec<_> = scene.views.iter().filter(|v| !v.test).collect();
    let pixels = train.iter().map(|v| {
        let camera = v.camera.scaled_to(long_side);
        camera.width as usize * camera.height as usize
    });
    SplatBudget::new(settings, scene.points.len(), train.len(), pixels.max().unwrap_or(0)).splats()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn affine() -> TrainSettings {
        TrainSettings { appearance_model: AppearanceModel::Affine, ..TrainSettings::default() }
    }

    #[test]
    fn photos_of_one_light_have_more_splats() {
        let one_light = TrainSettings { appearance_model: AppearanceModel::None, ..affine() };
        assert_eq!(SplatBudget::new(&one_light, 3_000, 25, 160_000).splats(), 40_000);
    }

    #[test]
    fn sky_needs_no_splats_and_points_keep_theirs() {
        let mut budget = SplatBudget::new(&affine(), 3_000, 25, 160_000);
        assert_eq!(budget.splats(), 32_000);
        budget.add_photo(1.0);
        budget.add_photo(0.5);
        assert_eq!(budget.splats(), 24_000);
        (0..200).for_each(|_| budget.add_photo(0.0));
        assert_eq!(budget.splats(), 3_000);
    }

    #[test]
    fn a_budget_from_the_settings_holds_whatever_the_photos_show() {
        let given = TrainSettings { splats: 1_234, ..TrainSettings::default() };
        let mut budget = SplatBudget::new(&given, 50_000, 25, 160_000);
        budget.add_photo(0.1);
        assert_eq!(budget.splats(), 1_234);
    }

    #[test]
    fn few_photos_and_many_points_stay_within_bounds() {
        let standard = affine();
        assert_eq!(SplatBudget::new(&standard, 0, 1, 100).splats(), 2_000);
        assert_eq!(SplatBudget::new(&standard, 90_000, 1, 100).splats(), 20_000);
        assert_eq!(SplatBudget::new(&standard, 90_000, 10_000, 1_000_000).splats(), 200_000);
    }
}
