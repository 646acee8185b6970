//! Multi-view pruning: removes splats without multi-view support. A transient that the robust mask misses is fitted by splats
//! right before that one camera; they float in the view of other photos, which show something else there.
//! Without pruning they stay for good: the other photos' robust masks leave them out as transients, and then no gradient
//! reaches them.

use segwild_raster::{Projected, RasterError};
use segwild_scene::Image;

/// Photos that must see a splat for it to stay. Those that contradict it count as well: at the rim of a scene
/// a splat has few photos, and a transient in one of them must not remove it.
const LEAST_PHOTOS: f32 = 2.5;
/// Least ratio of votes in favour to votes against for a splat to stay. At the foot of a building transients stand
/// before the ground in more than half of the photos, and each of these contradicts it.
const SHARE: f32 = 0.5;

/// The votes for and against each splat, in photos.
pub(crate) struct MultiViewPruning {
    in_favour: Vec<f32>,
    against: Vec<f32>,
    photos: u32,
}

impl MultiViewPruning {
    /// `splats` splats without votes.
    pub fn new(splats: usize) -> MultiViewPruning {
        MultiViewPruning { in_favour: vec![0.0; splats], against: vec![0.0; splats], photos: 0 }
    }

    /// Adds the votes of one photo.
    pub fn add_photo(
        &mut self,
        projected: &dyn Projected,
        width: usize,
        contradicted: &[bool],
        counts: impl Fn(usize) -> bool,
    ) -> Result<(), RasterError> {
        let votes = votes(projected, width, contradicted, counts)?;
        for (i, [in_favour, against]) in votes.into_iter().enumerate() {
            self.in_favour[i] += in_favour;
            self.against[i] += against;
        }
        self.photos += 1;
        Ok(())
    }

    /// The splats that stay. With few photos fewer are required; a splat that no photo sees stays.
    pub fn supported(&self) -> Vec<usize> {
        let least = LEAST_PHOTOS.min(0.1 * self.photos as f32);
        (0..self.in_favour.len())
            .filter(|&i| {
                let (yes, no) = (self.in_favour[i], self.against[i]);
                yes + no == 0.0 || (yes >= SHARE * no && yes + no >= least)
            })
            .collect()
    }
}

/// The votes of one photo for and against each splat: a splat seen over a pixel or more gets about one vote, in favour for the
/// share of its light where photo and scene agree, and against for the rest. `counts` gives the pixels that take part.
pub(crate) fn votes(
    projected: &dyn Projected,
    width: usize,
    contradicted: &[bool],
    counts: impl Fn(usize) -> bool,
) -> Result<Vec<[f32; 2]>, RasterError> {
    let mut pixels = Image::zeros(width, contradicted.len() / width, 2);
    for (i, &against) in contradicted.iter().enumerate() {
        if counts(i) {
            pixels.plane_mut(usize::from(against))[i] = 1.0;
        }
    }
    let light = projected.gather(&pixels)?;
    let vote = |light: &[f32]| {
        let vote = 1.0 / (light[0] + light[1] + 1.0);
        [light[0] * vote, light[1] * vote]
    };
    Ok(light.chunks_exact(2).map(vote).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_raster::{CpuEngine, ProjectOptions, Rasterizer};
    use segwild_scene::{Camera, Pose, Splats};

    /// A wall at depth 5 that three cameras side by side see, and a splat right before the first of them.
    fn wall_and_transient() -> Splats {
        let mut s = Splats { sh_degree: 0, ..Splats::default() };
        for i in 0..9 {
            s.means.push([f32::from(i % 3u8) - 1.0, f32::from(i / 3u8) - 1.0, 5.0]);
        }
        s.means.push([0.0, 0.0, 0.6]);
        let n = s.means.len();
        s.log_scales = vec![[-1.0; 3]; n];
        s.log_scales[n - 1] = [-3.2; 3];
        s.rotations = vec![[1.0, 0.0, 0.0, 0.0]; n];
        s.opacities = vec![3.0; n];
        s.sh = vec![0.5; 3 * n];
        s
    }

    /// What is left after some photos, each `apart` further to the right than the one before.
    fn left(apart: f32, photos: u32, contradicted: impl Fn(u32, usize) -> bool) -> Vec<usize> {
        let splats = wall_and_transient();
        let engine = CpuEngine::default();
        let mut multi_view_pruning = MultiViewPruning::new(splats.len());
        for photo in 0..photos {
            let camera = Camera { width: 48, height: 48, fx: 40.0, fy: 40.0, cx: 24.0, cy: 24.0 };
            let pose = Pose {
                rotation: glam::Mat3::IDENTITY,
                translation: glam::Vec3::new(-apart * photo as f32, 0.0, 0.0),
            };
            let projected = engine.project(&splats, &camera, &pose, &ProjectOptions::default()).unwrap();
            let seen: Vec<bool> = (0..48 * 48).map(|i| contradicted(photo, i)).collect();
            multi_view_pruning.add_photo(&*projected, 48, &seen, |_| true).unwrap();
        }
        multi_view_pruning.supported()
    }

    #[test]
    fn what_one_photo_put_before_its_camera_goes_and_the_wall_stays() {
        assert_eq!(left(0.6, 20, |_, _| false), (0..9).collect::<Vec<_>>());
    }

    #[test]
    fn what_the_photos_contradict_goes_however_many_see_it() {
        // The splat is at x = 24 - 40 * 0.05 / 0.6 per photo.
        let at = |photo: u32, i: usize| {
            let (x, y) = ((i % 48) as f32 - 24.0 + 3.3 * photo as f32, (i / 48) as f32 - 24.0);
            x.abs() < 7.0 && y.abs() < 7.0
        };
        assert!(left(0.05, 5, |_, _| false).contains(&9));
        let kept = left(0.05, 5, at);
        assert!(!kept.contains(&9) && kept.contains(&0) && kept.contains(&8), "{kept:?}");
    }

    #[test]
    fn ground_that_transients_occlude_in_most_photos_stays() {
        // Photos from one position: three of five contradict all they show.
        let kept = left(0.0, 20, |photo, _| photo % 5 < 3);
        assert_eq!(kept.len(), 10, "{kept:?}");
        assert!(left(0.0, 20, |photo, _| photo % 5 < 4).len() < 10);
    }

    #[test]
    fn what_few_photos_see_stays_where_transients_occlude_it_in_one_of_them() {
        let mut few = MultiViewPruning::new(3);
        (few.in_favour, few.against, few.photos) = (vec![2.0, 1.0, 1.0], vec![1.0, 2.5, 0.0], 40);
        assert_eq!(few.supported(), [0], "mostly contradicted, or seen by one alone, goes");
    }

    #[test]
    fn two_photos_keep_what_they_have() {
        assert_eq!(left(0.6, 2, |_, _| false).len(), 10);
    }
}
