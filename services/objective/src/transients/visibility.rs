//! The visibility map that the network of the appearance model `gsw` predicts for a photo (paper, Eq. 5, 6).
//!
//! The map learns from residuals, in units of the limit at which the robust mask takes a pixel for a transient. These
//! units follow the photo's median and the largest share that may be left out, so that neither a map that hides all
//! minimises the loss, nor one that hides nothing where residuals stand out.

use crate::photo_target::PhotoTarget;
use segwild_scene::Image;

/// A photo's visibility map, of one plane: the probability that a part of the photo shows the scene, in [0, 1].
#[derive(Clone, Copy, Debug)]
pub struct VisibilityMap<'a> {
    /// The map, smaller than the photo.
    pub map: &'a Image,
    /// Whether it may replace the robust mask.
    pub decides: bool,
}

/// Visibility from which a pixel counts in full; under [`OCCLUDED`] it does not count.
pub const SURE: f32 = 0.5;
/// Visibility under which a pixel does not count.
pub const OCCLUDED: f32 = 0.25;
/// A map may leave out so many times what the robust mask may leave out at most.
pub const MOST: f32 = 1.5;
/// And must leave out such a share of what it does leave out.
pub const LEAST: f32 = 0.3;
/// Residuals are clamped to so many times the limit, so that one outlier does not decide.
pub const WRONG: f32 = 4.0;

/// Per part of the photo that a pixel of the map covers, the mean of `ratio` over its pixels that count.
pub(crate) fn part_residuals(map: &Image, ratio: &[f32], photo: &PhotoTarget) -> Vec<Option<f32>> {
    let mut sums = vec![(0.0f32, 0u32); map.pixels()];
    for (i, ratio) in ratio.iter().enumerate().filter(|(i, _)| photo.is(*i, PhotoTarget::COUNTS)) {
        let (x, y) = (i % photo.width * map.width / photo.width, i / photo.width * map.height / photo.height);
        let sum = &mut sums[y * map.width + x];
        *sum = (sum.0 + ratio.min(WRONG), sum.1 + 1);
    }
    sums.into_iter().map(|(sum, n)| (n > 0).then(|| sum / n as f32)).collect()
}

/// Weight of each pixel by the map; `None` where the map is implausible against the robust mask: it leaves out much
/// more than `share`, or next to nothing where the mask leaves out something.
pub(crate) fn visibility_weights(
    map: &Image,
    photo: &PhotoTarget,
    kept: Option<&[f32]>,
    share: f32,
) -> Option<Vec<f32>> {
    let weight = |i: usize| {
        let at = |k: usize, of: usize, n: usize| (((k as f32 + 0.5) / of as f32) * n as f32 - 0.5).max(0.0);
        let (x, y) =
            (at(i % photo.width, photo.width, map.width), at(i / photo.width, photo.height, map.height));
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(map.width - 1), (y0 + 1).min(map.height - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let row = |y: usize| map.data[y * map.width + x0] * (1.0 - fx) + map.data[y * map.width + x1] * fx;
        ((row(y0) * (1.0 - fy) + row(y1) * fy - OCCLUDED) / (SURE - OCCLUDED)).clamp(0.0, 1.0)
    };
    let weights: Vec<f32> = (0..photo.pixels.len()).map(weight).collect();
    is_plausible(&weights, kept, |i| photo.is(i, PhotoTarget::COUNTS), share).then_some(weights)
}

fn is_plausible(weights: &[f32], kept: Option<&[f32]>, counts: impl Fn(usize) -> bool, share: f32) -> bool {
    let left_out = |weights: &[f32]| {
        let counted = || weights.iter().enumerate().filter(|(i, _)| counts(*i)).map(|(_, w)| 1.0 - w);
        counted().sum::<f32>() / counted().count().max(1) as f32
    };
    let own = left_out(weights);
    own <= MOST * share && own >= LEAST * kept.map_or(0.0, left_out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_that_hides_all_or_nothing_is_not_trusted() {
        let kept: Vec<f32> = (0..100).map(|i| f32::from(u8::from(i >= 10))).collect();
        let plausible = |weights: &[f32], kept| is_plausible(weights, kept, |_| true, 0.2);
        assert!(plausible(&kept, Some(&kept)));
        assert!(!plausible(&[0.0; 100], Some(&kept)) && !plausible(&[0.0; 100], None), "all occluded");
        assert!(!plausible(&[1.0; 100], Some(&kept)), "a transient in sight");
        assert!(plausible(&[1.0; 100], None), "nothing stands out");
        assert!(!is_plausible(&[f32::NAN; 100], None, |_| true, 0.2));
    }
}
