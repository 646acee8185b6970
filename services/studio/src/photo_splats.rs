//! Which splats each photo shows, for all photos of a run at once: small renders, kept as packed numbers. A run of a thousand photos
//! needs some 20 MB, where the maps of [`crate::fronts`] need a gigabyte.

use crate::fronts::FrontMap;
use segwild_flow::lock;
use segwild_pipeline::{RunError, Session};
use segwild_raster::NO_SPLAT;
use segwild_scene::Camera;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

/// Long side in pixels of the renders.
const SIDE: u32 = 128;

/// Bits of a number in a byte of [`SplatCounts`]; the eighth says that more of them follow.
const BITS: u32 = 7;

/// The splats in front in one photo, and at how many pixels each is.
#[derive(Debug, PartialEq)]
struct SplatCounts {
    /// Per splat, in order: how far its index lies after the one before, and its pixels. Seven bits a byte, from the lowest.
    packed: Box<[u8]>,
    /// Pixels of the photo at working size for one that was counted.
    weight: f64,
}

impl SplatCounts {
    /// Counts the splats of a small map of a photo that has `pixels` at working size.
    fn of(map: &FrontMap, pixels: usize) -> SplatCounts {
        let mut splats: Vec<u32> = map.splats.iter().copied().filter(|splat| *splat != NO_SPLAT).collect();
        splats.sort_unstable();
        let (mut packed, mut before) = (Vec::new(), 0);
        for same in splats.chunk_by(|a, b| a == b) {
            add(&mut packed, same[0] - before);
            add(&mut packed, same.len() as u32);
            before = same[0];
        }
        SplatCounts { packed: packed.into(), weight: pixels as f64 / map.splats.len().max(1) as f64 }
    }

    /// Pixels of the photo, at working size, that show one of the labelled splats.
    fn pixels(&self, labels: &[bool]) -> usize {
        let (mut rest, mut splat, mut pixels) = (&*self.packed, 0u32, 0u64);
        while !rest.is_empty() {
            splat = splat.saturating_add(take(&mut rest));
            let count = take(&mut rest);
            if labels.get(splat as usize) == Some(&true) {
                pixels += u64::from(count);
            }
        }
        (pixels as f64 * self.weight).round() as usize
    }
}

fn add(packed: &mut Vec<u8>, mut number: u32) {
    while number >= 1 << BITS {
        packed.push(number as u8 | 1 << BITS);
        number >>= BITS;
    }
    packed.push(number as u8);
}

fn take(rest: &mut &[u8]) -> u32 {
    let (mut number, mut shift) = (0u32, 0);
    while let Some((&byte, after)) = rest.split_first() {
        *rest = after;
        number |= u32::from(byte & !(1 << BITS)).checked_shl(shift).unwrap_or(0);
        shift += BITS;
        if byte >> BITS == 0 {
            break;
        }
    }
    number
}

/// Which splats the photos of a session show, as far as that was needed.
#[derive(Default)]
pub(crate) struct PhotoSplats {
    photos: Mutex<BTreeMap<usize, Arc<SplatCounts>>>,
    /// Held by the one request that finds out what is missing: others wait for it without a thread.
    turn: Arc<tokio::sync::Mutex<()>>,
}

impl PhotoSplats {
    /// The turn to find out what is missing.
    pub fn turn(&self) -> Arc<tokio::sync::Mutex<()>> {
        self.turn.clone()
    }

    /// Whether it is known what a photo shows.
    pub fn knows(&self, photo: usize) -> bool {
        lock(&self.photos).contains_key(&photo)
    }

    /// Pixels of a photo, at working size, that show one of the labelled splats; what the photo shows is found out if it is not known.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn pixels(&self, session: &Session, photo: usize, labels: &[bool]) -> Result<usize, RunError> {
        let known = lock(&self.photos).get(&photo).cloned();
        let counts = match known {
            Some(counts) => counts,
            None => self.find(session, photo)?,
        };
        Ok(counts.pixels(labels))
    }

    fn find(&self, session: &Session, photo: usize) -> Result<Arc<SplatCounts>, RunError> {
        let working = session.working_camera(photo);
        let pixels = |camera: &Camera| camera.width as usize * camera.height as usize;
        let front = session.front_from(&working.scaled_to(SIDE), &session.scene().views[photo].pose)?;
        let counts = Arc::new(SplatCounts::of(&FrontMap::from(front), pixels(&working)));
        lock(&self.photos).insert(photo, counts.clone());
        Ok(counts)
    }

    /// Bytes of all that is known.
    pub fn bytes(&self) -> usize {
        lock(&self.photos).values().map(|counts| counts.packed.len()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_counts_are_those_of_the_map() {
        let splats = vec![7, 7, NO_SPLAT, 300, 7, 0, 2_000_000_000, 300];
        let map = FrontMap { width: 4, height: 2, splats: splats.clone() };
        let counts = SplatCounts::of(&map, 32);
        assert_eq!(counts.weight, 4.0);
        let of = |wanted: &[u32]| {
            let labels: Vec<bool> = (0..400).map(|splat| wanted.contains(&splat)).collect();
            counts.pixels(&labels)
        };
        assert_eq!([of(&[7]), of(&[300]), of(&[0, 300]), of(&[8]), of(&[])], [12, 8, 12, 0, 0]);
        // 1, 1, 2 and 5 bytes for the distances, and one for each number of pixels.
        assert_eq!(counts.packed.len(), 1 + 1 + 2 + 5 + 4);
    }

    #[test]
    fn a_thousand_photos_without_two_pixels_alike_take_less_than_fifty_megabytes() {
        let spread = |i: u32| i.wrapping_mul(2_654_435_761) % 3_000_000;
        let map = FrontMap { width: 128, height: 96, splats: (0..128 * 96).map(spread).collect() };
        assert!(1000 * SplatCounts::of(&map, 640 * 480).packed.len() < 50 << 20);
    }

    #[test]
    fn numbers_that_are_cut_short_or_too_long_end() {
        for bytes in [&[0x80][..], &[0xff; 9][..], &[]] {
            let mut rest = bytes;
            take(&mut rest);
            assert!(rest.is_empty());
        }
    }
}
