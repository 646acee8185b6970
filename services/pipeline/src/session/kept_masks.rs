//! Masks of photos that clicks read again and again, kept in memory.

use segwild_flow::lock;
use segwild_scene::Mask;
use std::collections::HashMap;
use std::sync::Mutex;

/// Bytes of masks that a session keeps of a kind. What does not fit is read by each click.
pub(super) const MASK_BYTES: usize = 64 << 20;

/// Masks of one kind, each with the version of what it was read from.
pub(super) struct KeptMasks<V> {
    most_bytes: usize,
    held: Mutex<HeldMasks<V>>,
}

struct HeldMasks<V> {
    of_views: HashMap<usize, (V, Mask)>,
    bytes: usize,
}

impl<V: PartialEq> KeptMasks<V> {
    /// None yet, of so many bytes at most.
    pub fn within(most_bytes: usize) -> KeptMasks<V> {
        KeptMasks { most_bytes, held: Mutex::new(HeldMasks { of_views: HashMap::new(), bytes: 0 }) }
    }

    /// The mask of a view: the kept one where it is of this version, or as it is read now. One that cannot be read is not kept.
    pub fn read(&self, view: usize, version: V, read: impl FnOnce() -> Option<Mask>) -> Option<Mask> {
        let held = lock(&self.held);
        if let Some((of, mask)) = held.of_views.get(&view)
            && *of == version
        {
            return Some(mask.clone());
        }
        drop(held);
        let mask = read()?;
        let mut held = lock(&self.held);
        if let Some((_, earlier)) = held.of_views.remove(&view) {
            held.bytes -= bytes_of(&earlier);
        }
        if held.bytes + bytes_of(&mask) <= self.most_bytes {
            held.bytes += bytes_of(&mask);
            held.of_views.insert(view, (version, mask.clone()));
        }
        Some(mask)
    }
}

/// A bit per pixel.
fn bytes_of(mask: &Mask) -> usize {
    (mask.width() as usize * mask.height() as usize).div_ceil(8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_is_read_once_and_again_when_its_image_has_changed() {
        let kept = KeptMasks::within(2 * 100);
        let mut reads = 0;
        let mut read = |view: usize, version: u32, columns: u32| {
            let mask = kept.read(view, version, || {
                reads += 1;
                (columns > 0).then(|| Mask::from_fn(40, 20, |x, _| x < columns))
            });
            (mask.map(|mask| mask.count()), reads)
        };
        assert_eq!(read(0, 1, 5), (Some(100), 1));
        assert_eq!(read(0, 1, 9), (Some(100), 1), "it is at hand");
        assert_eq!(read(0, 2, 9), (Some(180), 2), "a person has corrected it");
        assert_eq!(read(1, 1, 0), (None, 3));
        assert_eq!(read(1, 1, 3), (Some(60), 4), "what could not be read is read again");
        // The third does not fit.
        assert_eq!([read(2, 1, 1), read(2, 1, 2)], [(Some(20), 5), (Some(40), 6)]);
        assert_eq!(read(1, 1, 1), (Some(60), 6));
    }
}
