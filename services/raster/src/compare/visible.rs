//! What a photo shows of the scene, as the network of the look `gsw` sees it: the paper's visibility map (Eq. 5, 6).
//!
//! The map learns from what the scene fails to show, in units of the residual at which the robust mask takes a pixel for a
//! transient's. These units follow the photo's median and the largest share that may be left out, so that a map that hides
//! all is never the best one, nor one that hides nothing where something stands out.

use super::Target;
use segwild_scene::Image;

/// A photo's map, of one plane: how sure the network is that a part of the photo shows the scene, in [0, 1].
#[derive(Clone, Copy, Debug)]
pub struct Seeing<'a> {
    /// The map, smaller than the photo.
    pub map: &'a Image,
    /// Whether it may take the robust mask's place.
    pub decides: bool,
}

/// Visibility from which a pixel counts in full, and under which it does not count.
pub const SURE: f32 = 0.5;
/// See [`SURE`].
pub const HIDDEN_LAYER: f32 = 0.25;
/// A map may leave out so many times what the robust mask may leave out at most.
pub const MOST: f32 = 1.5;
/// And must leave out such a share of what it does leave out.
pub const LEAST: f32 = 0.3;
/// More than so many times the limit is no more a transient than that: one pixel that is wrong by far is none.
pub const WRONG: f32 = 4.0;

/// Per part of the photo that the map tells of, the mean of `ratio` over its pixels that count.
pub(super) fn blame(map: &Image, ratio: &[f32], photo: &Target) -> Vec<Option<f32>> {
    let mut sums = vec![(0.0f32, 0u32); map.pixels()];
    for (i, ratio) in ratio.iter().enumerate().filter(|(i, _)| photo.is(*i, Target::COUNTS)) {
        let (x, y) = (i % photo.width * map.width / photo.width, i / photo.width * map.height / photo.height);
        let sum = &mut sums[y * map.width + x];
        *sum = (sum.0 + ratio.min(WRONG), sum.1 + 1);
    }
    sums.into_iter().map(|(sum, n)| (n > 0).then(|| sum / n as f32)).collect()
}

/// Weight of each pixel by the map; `None` where the map cannot be trusted beside what the robust mask keeps: one that
/// leaves out much more than `share`, or next to nothing where the mask leaves out something.
pub(super) fn weights(map: &Image, photo: &Target, kept: Option<&[f32]>, share: f32) -> Option<Vec<f32>> {
    let weight = |i: usize| {
        let at = |k: usize, of: usize, n: usize| (((k as f32 + 0.5) / of as f32) * n as f32 - 0.5).max(0.0);
        let (x, y) =
            (at(i % photo.width, photo.width, map.width), at(i / photo.width, photo.height, map.height));
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(map.width - 1), (y0 + 1).min(map.height - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let row = |y: usize| map.data[y * map.width + x0] * (1.0 - fx) + map.data[y * map.width + x1] * fx;
        ((row(y0) * (1.0 - fy) + row(y1) * fy - HIDDEN_LAYER) / (SURE - HIDDEN_LAYER)).clamp(0.0, 1.0)
    };
    let weights: Vec<f32> = (0..photo.pixels.len()).map(weight).collect();
    is_sane(&weights, kept, |i| photo.is(i, Target::COUNTS), share).then_some(weights)
}

fn is_sane(weights: &[f32], kept: Option<&[f32]>, counts: impl Fn(usize) -> bool, share: f32) -> bool {
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
        let sane = |weights: &[f32], kept| is_sane(weights, kept, |_| true, 0.2);
        assert!(sane(&kept, Some(&kept)));
        assert!(!sane(&[0.0; 100], Some(&kept)) && !sane(&[0.0; 100], None), "all hidden");
        assert!(!sane(&[1.0; 100], Some(&kept)), "a transient in sight");
        assert!(sane(&[1.0; 100], None), "nothing stands out");
        assert!(!is_sane(&[f32::NAN; 100], None, |_| true, 0.2));
    }
}
