//! Which splats each view shows. It depends on the scene alone, so that the first click computes it for all that follow.

use crate::coverage::visible;
use crate::request::project;
use crate::{Request, SegmentError};
use std::borrow::Cow;
use std::sync::OnceLock;

/// Long side in pixels at which views are compared by what they show.
const COMPARED_SIZE: u32 = 128;

/// Memory for what the views show, at most: a bit per splat and view. Where a scene takes more, each click computes it.
const MAX_BYTES: usize = 64 << 20;

/// One bit per splat.
#[derive(Clone, Debug)]
pub(crate) struct SplatSet(Vec<u64>);

impl SplatSet {
    pub fn new(flags: impl ExactSizeIterator<Item = bool>) -> SplatSet {
        let mut words = vec![0; flags.len().div_ceil(64)];
        for (i, flag) in flags.enumerate() {
            words[i / 64] |= u64::from(flag) << (i % 64);
        }
        SplatSet(words)
    }

    pub fn overlap(&self, other: &SplatSet) -> u32 {
        self.0.iter().zip(&other.0).map(|(a, b)| (a & b).count_ones()).sum()
    }

    fn shown_in(request: &Request, index: usize) -> Result<SplatSet, SegmentError> {
        let view = &request.views[index];
        let camera = view.camera.scaled_to(COMPARED_SIZE);
        let projected = project(request, view, &camera)?;
        let shown =
            visible(&*projected, (camera.width, camera.height)).map_err(SegmentError::raster(&view.name))?;
        Ok(SplatSet::new(shown.into_iter()))
    }
}

/// The splats that the views of a scene show, as far as they were needed.
#[derive(Debug)]
pub struct ViewSplats {
    splats: usize,
    views: Vec<OnceLock<SplatSet>>,
}

impl ViewSplats {
    /// Nothing yet of so many splats and views; `None` where they would take too much memory.
    pub fn new(splats: usize, views: usize) -> Option<ViewSplats> {
        let bytes = splats.div_ceil(8).saturating_mul(views);
        (bytes <= MAX_BYTES)
            .then(|| ViewSplats { splats, views: (0..views).map(|_| OnceLock::new()).collect() })
    }

    fn of(&self, request: &Request, index: usize) -> Result<&SplatSet, SegmentError> {
        let known = &self.views[index];
        if known.get().is_none() {
            // Another click may have set the same meanwhile.
            let _ = known.set(SplatSet::shown_in(request, index)?);
        }
        Ok(known.get_or_init(|| SplatSet(Vec::new())))
    }
}

/// The splats that a view shows: those at hand, or computed.
pub(crate) fn shown_in<'a>(request: &Request<'a>, index: usize) -> Result<Cow<'a, SplatSet>, SegmentError> {
    let of_scene = |shown: &&ViewSplats| {
        shown.splats == request.splats.len() && shown.views.len() == request.views.len()
    };
    match request.shown.filter(of_scene) {
        Some(shown) => shown.of(request, index).map(Cow::Borrowed),
        None => SplatSet::shown_in(request, index).map(Cow::Owned),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_that_would_take_too_much_memory_keeps_nothing() {
        assert!(ViewSplats::new(20_000, 60).is_some());
        assert!(ViewSplats::new(2_000_000, 1000).is_none());
        assert!(ViewSplats::new(usize::MAX, usize::MAX).is_none());
    }

    #[test]
    fn sets_overlap_by_what_both_hold() {
        let of = |divisor: usize| SplatSet::new((0..200).map(move |i| i % divisor == 0));
        assert_eq!((of(2).overlap(&of(3)), of(7).overlap(&of(7))), (34, 29));
    }
}
