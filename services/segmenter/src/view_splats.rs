//! Which splats each view shows. It depends on the scene alone, so that the first clicks compute it for all that follow.

use crate::coverage::visible;
use rayon::prelude::*;
use segwild_flow::lock;
use segwild_raster::{ProjectOptions, RasterError, Rasterizer};
use segwild_scene::{Camera, Pose, Splats};
use std::collections::HashMap;
use std::ops::Range;
use std::sync::{Arc, Mutex};

/// Long side in pixels at which the views are compared: to select them, and to find a good order.
const ORDER_SIZE: u32 = 128;

/// Memory for what the views show, at most: a bit per splat and view. What does not fit is computed by each click that needs it.
const MAX_BYTES: usize = 64 << 20;

/// Photos of a scene up to which what they show is computed before a click needs it: of more, a click compares some (method,
/// section 6.9).
const MOST_AHEAD: usize = 128;

/// One bit per splat.
#[derive(Clone, Debug)]
pub(crate) struct SplatSet(Vec<u64>);

impl SplatSet {
    /// Those of so many splats that it `holds`.
    pub fn of(splats: usize, holds: impl Fn(usize) -> bool + Sync) -> SplatSet {
        let word = |word: usize| {
            let of_word = 64 * word..splats.min(64 * (word + 1));
            of_word.fold(0u64, |bits, splat| bits | (u64::from(holds(splat)) << (splat % 64)))
        };
        SplatSet((0..splats.div_ceil(64)).into_par_iter().with_min_len(16).map(word).collect())
    }

    /// The splats of a scene that a view shows, at the size at which views are compared.
    pub fn in_view(
        rasterizer: &dyn Rasterizer,
        splats: &Splats,
        options: &ProjectOptions,
        camera: &Camera,
        pose: &Pose,
    ) -> Result<SplatSet, RasterError> {
        let camera = camera.scaled_to(ORDER_SIZE);
        let projected = rasterizer.project(splats, &camera, pose, options)?;
        let shown = visible(&*projected, (camera.width, camera.height))?;
        Ok(SplatSet::of(shown.len(), |splat| shown[splat]))
    }

    pub fn contains(&self, splat: usize) -> bool {
        self.0.get(splat / 64).is_some_and(|word| word >> (splat % 64) & 1 == 1)
    }

    pub fn overlap(&self, other: &SplatSet) -> u32 {
        self.0.iter().zip(&other.0).map(|(a, b)| (a & b).count_ones()).sum()
    }
}

/// The splats that the views of a scene show, as far as they were needed and fit into memory.
#[derive(Debug)]
pub struct ViewSplats {
    splats: usize,
    views: usize,
    /// Views whose splats fit into memory.
    most: usize,
    known: Mutex<HashMap<usize, Arc<SplatSet>>>,
}

impl ViewSplats {
    /// Nothing yet of so many splats and views; `None` where the splats of one view take too much memory.
    pub fn new(splats: usize, views: usize) -> Option<ViewSplats> {
        let most = MAX_BYTES / splats.div_ceil(8).max(1);
        (most > 0).then(|| ViewSplats { splats, views, most, known: Mutex::default() })
    }

    /// The views of which what they show is worth knowing before the first click: all, or none where they are many or do not
    /// fit into memory.
    pub fn ahead(&self) -> Range<usize> {
        if self.views <= self.most.min(MOST_AHEAD) { 0..self.views } else { 0..0 }
    }

    /// Bytes that the views known so far take in memory.
    pub fn bytes(&self) -> usize {
        lock(&self.known).len() * size_of::<u64>() * self.splats.div_ceil(64)
    }

    /// Whether it is of a scene with so many splats and views.
    pub(crate) fn fits(&self, splats: usize, views: usize) -> bool {
        self.splats == splats && self.views == views
    }

    /// The splats that a view shows, computed where they are not known yet.
    pub(crate) fn of<E>(
        &self,
        view: usize,
        compute: impl FnOnce() -> Result<SplatSet, E>,
    ) -> Result<Arc<SplatSet>, E> {
        if let Some(known) = lock(&self.known).get(&view) {
            return Ok(known.clone());
        }
        let computed = Arc::new(compute()?);
        let mut known = lock(&self.known);
        if known.len() < self.most {
            known.insert(view, computed.clone());
        }
        Ok(computed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_fit_into_memory_is_computed_again() {
        let computed = |scene: &ViewSplats, view: usize| {
            let mut calls = 0;
            for _ in 0..2 {
                let set = scene.of(view, || {
                    calls += 1;
                    Ok::<_, ()>(SplatSet::of(100, |i| i == view))
                });
                assert!(set.is_ok_and(|set| set.contains(view) && !set.contains(view + 1)));
            }
            calls
        };
        let small = ViewSplats::new(20_000, 60).unwrap();
        assert!((0..60).all(|view| computed(&small, view) == 1));
        assert_eq!(small.bytes(), 60 * 8 * 20_000usize.div_ceil(64));
        let large = ViewSplats::new(200_000_000, 1000).unwrap();
        let calls: Vec<usize> = (0..4).map(|view| computed(&large, view)).collect();
        assert_eq!(calls, [1, 1, 2, 2]);
        assert!(ViewSplats::new(usize::MAX, usize::MAX).is_none());
        assert_eq!((small.ahead(), large.ahead()), (0..60, 0..0));
    }

    #[test]
    fn sets_overlap_by_what_both_hold() {
        let of = |divisor: usize| SplatSet::of(200, |i| i % divisor == 0);
        assert_eq!((of(2).overlap(&of(3)), of(7).overlap(&of(7))), (34, 29));
        let seventh: Vec<usize> = (0..400).filter(|&i| of(7).contains(i)).collect();
        assert!(seventh.into_iter().eq((0..200).step_by(7)));
    }
}
