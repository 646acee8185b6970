//! The bounds of an object's mask.

use segwild_scene::Mask;

/// The first column and row of a mask's pixels, and those after the last; `None` where it is empty.
pub(crate) fn bounds(mask: &Mask) -> Option<([u32; 2], [u32; 2])> {
    mask.pixels().fold(None, |bounds, (x, y)| {
        let (low, high) = bounds.unwrap_or(([x, y], [x, y]));
        Some(([low[0].min(x), low[1].min(y)], [high[0].max(x + 1), high[1].max(y + 1)]))
    })
}
