//! The views that see each splat, and the regions of them in which each is seen.

/// Sightings of a block: with the number of the block before it, 60 bytes.
const IN_BLOCK: usize = 14;

/// Blocks that are allocated at once: 240 KiB.
const IN_SLAB: usize = 1 << 12;

/// Stands for "no block".
const NO_BLOCK: u32 = u32::MAX;

/// The region of a view that holds the pixel of a splat's largest share.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct RegionInView {
    /// Index of the view among those that were added.
    pub view: u16,
    /// The number of the region.
    pub region: u16,
}

/// Some sightings of one splat, in the order in which they were added.
struct SightingBlock {
    sightings: [RegionInView; IN_BLOCK],
    /// Number of the splat's block before it.
    earlier: u32,
}

/// Sightings by splat. It holds 8 bytes per splat, and about 4.5 per sighting where there are many: the blocks of a splat
/// are chained, and none is ever copied into a larger array.
pub(super) struct Sightings {
    /// Per splat, how many there are.
    counts: Vec<u32>,
    /// Per splat, the number of its latest block.
    latest: Vec<u32>,
    /// All blocks: [`IN_SLAB`] in each slab but the last.
    slabs: Vec<Vec<SightingBlock>>,
}

impl Sightings {
    /// Without sightings yet.
    pub fn new(splats: usize) -> Sightings {
        Sightings { counts: vec![0; splats], latest: vec![NO_BLOCK; splats], slabs: Vec::new() }
    }

    /// How many views see a splat.
    pub fn count(&self, splat: usize) -> usize {
        self.counts[splat] as usize
    }

    /// Adds one of a splat.
    pub fn add(&mut self, splat: usize, sighting: RegionInView) {
        let at = self.count(splat) % IN_BLOCK;
        if at == 0 {
            self.latest[splat] = self.new_block(self.latest[splat]);
        }
        let block = self.latest[splat] as usize;
        self.slabs[block / IN_SLAB][block % IN_SLAB].sightings[at] = sighting;
        self.counts[splat] += 1;
    }

    /// Those of a splat, the latest first.
    pub fn latest_first(&self, splat: usize) -> impl Iterator<Item = RegionInView> {
        let (mut left, mut block) = (self.count(splat), self.latest[splat] as usize);
        std::iter::from_fn(move || {
            left = left.checked_sub(1)?;
            let held = &self.slabs[block / IN_SLAB][block % IN_SLAB];
            if left % IN_BLOCK == 0 {
                block = held.earlier as usize;
            }
            Some(held.sightings[left % IN_BLOCK])
        })
    }

    /// Makes a block that follows another of the same splat, and returns its number.
    fn new_block(&mut self, earlier: u32) -> u32 {
        if self.slabs.last().is_none_or(|slab| slab.len() == IN_SLAB) {
            self.slabs.push(Vec::with_capacity(IN_SLAB));
        }
        let full = (self.slabs.len() - 1) * IN_SLAB;
        let slab = self.slabs.last_mut().expect("one was just made where there was none");
        slab.push(SightingBlock { sightings: [RegionInView::default(); IN_BLOCK], earlier });
        // As many blocks as this counts take 240 GiB.
        (full + slab.len() - 1) as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sightings_are_those_of_a_list_for_each_splat() {
        let (splats, mut state) = (1000, 7u64);
        let mut random = |below: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) % below
        };
        let (mut sightings, mut lists) = (Sightings::new(splats), vec![Vec::new(); splats]);
        for view in 0..200 {
            for splat in 0..splats {
                // Some splats are seen by all views, and some by none.
                if random(splats as u64 - 1) < splat as u64 {
                    let sighting = RegionInView { view, region: random(1 << 16) as u16 };
                    sightings.add(splat, sighting);
                    lists[splat].push(sighting);
                }
            }
        }
        assert!(sightings.slabs.len() > 1, "more than one slab is in use");
        for (splat, list) in lists.iter().enumerate() {
            assert_eq!(sightings.count(splat), list.len());
            assert!(sightings.latest_first(splat).eq(list.iter().rev().copied()), "splat {splat}");
        }
        assert_eq!((sightings.count(0), sightings.count(splats - 1)), (0, 200));
    }
}
