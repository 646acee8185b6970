//! Which splats each view shows. It depends on the scene alone, so that the first click computes it for all that follow.

use std::sync::OnceLock;

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

    /// Whether it is of a scene with so many splats and views.
    pub(crate) fn fits(&self, splats: usize, views: usize) -> bool {
        self.splats == splats && self.views.len() == views
    }

    /// The splats that a view shows, computed where they are not known yet.
    pub(crate) fn of<E>(
        &self,
        view: usize,
        compute: impl FnOnce() -> Result<SplatSet, E>,
    ) -> Result<&SplatSet, E> {
        let known = &self.views[view];
        if let Some(known) = known.get() {
            return Ok(known);
        }
        let computed = compute()?;
        Ok(known.get_or_init(|| computed))
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
