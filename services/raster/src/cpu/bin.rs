//! Which splats touch which tiles, nearest first.
//!
//! Splats are dealt to tiles in the order in which they are stored, and every tile sorts its own list by depth. So no
//! pass reads memory by depth: a view of millions of splats does not fit a cache, but the list of a tile does, and the
//! tiles are sorted in parallel.

use super::project::{LOG2_ALPHA_MIN, Projector, SLACK, SplatFootprint};
use super::simd::{self, Isa, Simd, SimdKernel};
use rayon::prelude::*;
use segwild_scene::Splats;

/// Width of a tile in pixels.
pub(crate) const WIDTH: usize = 32;
/// Height of a tile in pixels.
pub(crate) const HEIGHT: usize = 16;
/// Splats that one task projects; a span numbers them in 16 bits.
const CHUNK: usize = 512;
/// Entries of a tile from which on they are sorted digit by digit instead of by comparison.
const RADIX: usize = 256;

/// One splat in one tile.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct TileEntry {
    /// The splat.
    pub splat: u32,
    /// Its index among all (splat, tile) pairs in the order of splats, then tiles.
    pub slot: u32,
}

/// A run of tiles in one row of tiles, which one splat touches.
#[derive(Clone, Copy, Debug, Default)]
struct TileSpan {
    /// The splat, counted from the first of its chunk.
    splat: u16,
    row: u16,
    from: u16,
    to: u16,
}

/// The splats of one view, dealt to tiles. Its memory is kept from view to view.
#[derive(Debug, Default)]
pub(crate) struct Bins {
    pub columns: usize,
    pub rows: usize,
    pub depths: Vec<f32>,
    pub radii: Vec<f32>,
    pub centres: Vec<[f32; 2]>,
    pub footprints: Vec<SplatFootprint>,
    /// `slots[i]..slots[i + 1]` are the slots of splat i, in row-major order of tiles.
    pub slots: Vec<u32>,
    /// `starts[t]..starts[t + 1]` are the entries of tile t.
    pub starts: Vec<u32>,
    pub entries: Vec<TileEntry>,
    /// Per chunk, in the order of splats, then rows.
    spans: Vec<Vec<TileSpan>>,
    cursors: Vec<u32>,
}

impl Bins {
    /// Projects all splats and deals them to tiles; refuses more pairs of a splat and a tile than 32 bits can number,
    /// and returns their number.
    pub fn fill(&mut self, isa: Isa, splats: &Splats, projector: &Projector) -> Result<(), u64> {
        let n = splats.len();
        self.columns = projector.width.div_ceil(WIDTH);
        self.rows = projector.height.div_ceil(HEIGHT);
        self.depths.resize(n, 0.0);
        self.radii.resize(n, 0.0);
        self.centres.resize(n, [0.0; 2]);
        self.footprints.resize(n, SplatFootprint::default());
        self.slots.resize(n + 1, 0);
        self.spans.resize_with(n.div_ceil(CHUNK), Vec::new);
        let counts = &mut self.slots[1..];
        self.depths
            .par_chunks_mut(CHUNK)
            .zip(self.radii.par_chunks_mut(CHUNK))
            .zip(self.centres.par_chunks_mut(CHUNK))
            .zip(self.footprints.par_chunks_mut(CHUNK))
            .zip(counts.par_chunks_mut(CHUNK))
            .zip(self.spans.par_iter_mut())
            .enumerate()
            .for_each(|(chunk, (((((depths, radii), centres), prints), counts), spans))| {
                let first = chunk * CHUNK;
                let kernel =
                    Chunk { splats, projector, first, depths, radii, centres, prints, counts, spans };
                simd::run(isa, kernel);
            });

        numbered(&self.slots[1..])?;
        self.starts.clear();
        self.starts.resize(self.columns * self.rows + 1, 0);
        for span in self.spans.iter().flatten() {
            let row = span.row as usize * self.columns + 1;
            for start in &mut self.starts[row + span.from as usize..=row + span.to as usize] {
                *start += 1;
            }
        }
        prefix_sum(&mut self.starts);
        prefix_sum(&mut self.slots);
        self.deal();
        self.sort_tiles();
        Ok(())
    }

    /// Deals the splats to the tiles in the order of splats, in which the slots are numbered too.
    fn deal(&mut self) {
        self.cursors.clear();
        self.cursors.extend_from_slice(&self.starts);
        self.entries.resize(self.slots[self.depths.len()] as usize, TileEntry::default());
        let mut slot = 0;
        for (chunk, spans) in self.spans.iter().enumerate() {
            let first = (chunk * CHUNK) as u32;
            for span in spans {
                let splat = first + u32::from(span.splat);
                let row = span.row as usize * self.columns;
                for cursor in &mut self.cursors[row + span.from as usize..=row + span.to as usize] {
                    self.entries[*cursor as usize] = TileEntry { splat, slot };
                    *cursor += 1;
                    slot += 1;
                }
            }
        }
    }

    /// Sorts the entries of every tile by depth.
    fn sort_tiles(&mut self) {
        let depths = self.depths.as_slice();
        let mut tiles = Vec::with_capacity(self.starts.len() - 1);
        let mut rest = self.entries.as_mut_slice();
        for ends in self.starts.windows(2) {
            let (tile, after) = rest.split_at_mut((ends[1] - ends[0]) as usize);
            tiles.push(tile);
            rest = after;
        }
        tiles.into_par_iter().for_each_init(TileSort::default, |memory, tile| memory.sort(tile, depths));
    }

    /// Entries of a tile, nearest first.
    pub fn tile(&self, tile: usize) -> &[TileEntry] {
        &self.entries[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }

    /// Bytes of memory that it keeps.
    pub fn bytes(&self) -> usize {
        fn of<T>(values: &Vec<T>) -> usize {
            size_of::<T>() * values.capacity()
        }
        let of_splats = of(&self.depths) + of(&self.radii) + of(&self.centres) + of(&self.footprints);
        let of_tiles = of(&self.slots) + of(&self.starts) + of(&self.entries) + of(&self.cursors);
        of_splats + of_tiles + of(&self.spans) + self.spans.iter().map(of).sum::<usize>()
    }

    /// Number of (splat, tile) pairs.
    pub fn pairs(&self) -> usize {
        self.entries.len()
    }
}

/// Projects the splats from `first` on, as many as the slices are long.
struct Chunk<'a> {
    splats: &'a Splats,
    projector: &'a Projector,
    first: usize,
    depths: &'a mut [f32],
    radii: &'a mut [f32],
    centres: &'a mut [[f32; 2]],
    prints: &'a mut [SplatFootprint],
    counts: &'a mut [u32],
    spans: &'a mut Vec<TileSpan>,
}

// Scalar code, but the wider sets have shorter instructions for it too.
impl SimdKernel for Chunk<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        self.spans.clear();
        for k in 0..self.depths.len() {
            let i = self.first + k;
            let (depth, centre) = self.projector.centre(self.splats.means[i]);
            self.depths[k] = if depth.is_finite() { depth } else { 0.0 };
            self.centres[k] = centre;
            self.radii[k] = 0.0;
            self.counts[k] = match self.projector.shape(self.splats, i) {
                Some(shape) => {
                    self.radii[k] = shape.radius;
                    self.prints[k] = shape.footprint;
                    cover(k as u16, &shape.footprint, shape.tip, self.projector, self.spans)
                }
                None => 0,
            };
        }
    }
}

/// Adds the tiles that hold a pixel centre of the ellipse where alpha reaches 1/255; returns their number.
#[inline(always)]
fn cover(splat: u16, f: &SplatFootprint, tip: f32, projector: &Projector, spans: &mut Vec<TileSpan>) -> u32 {
    let (right, bottom) = (projector.width as f32 - 1.0, projector.height as f32 - 1.0);
    let top = (f.y - f.reach - 0.5).ceil().max(0.0);
    let low = (f.y + f.reach - 0.5).floor().min(bottom);
    if top > low {
        return 0;
    }
    let mut count = 0;
    let above = f.lo - LOG2_ALPHA_MIN;
    let half = |dy: f32| ((above - f.e * dy * dy) * f.inv_a).max(0.0).sqrt() + SLACK;
    for row in top as usize / HEIGHT..=low as usize / HEIGHT {
        // Rows of pixel centres, relative to the splat. The band cuts a convex shape, so each side's farthest
        // point is the shape's own, or lies on the nearer edge of the band.
        let from = (((row * HEIGHT) as f32).max(top) + 0.5 - f.y).max(-f.reach);
        let to = (((row * HEIGHT + HEIGHT - 1) as f32).min(low) + 0.5 - f.y).min(f.reach);
        let at = |dy: f32| dy.max(from).min(to);
        let (dl, dr) = (at(-tip), at(tip));
        let left = (f.x + f.slope * dl - half(dl) - 0.5).ceil().max(0.0);
        let far = (f.x + f.slope * dr + half(dr) - 0.5).floor().min(right);
        if left <= far {
            let span = TileSpan {
                splat,
                row: row as u16,
                from: (left as usize / WIDTH) as u16,
                to: (far as usize / WIDTH) as u16,
            };
            count += u32::from(span.to - span.from) + 1;
            spans.push(span);
        }
    }
    count
}

/// Refuses counts whose sum is no 32-bit number.
fn numbered(counts: &[u32]) -> Result<(), u64> {
    let sum = counts.iter().map(|&count| u64::from(count)).sum();
    if sum > u64::from(u32::MAX) { Err(sum) } else { Ok(()) }
}

/// Turns counts, shifted by one, into starts.
fn prefix_sum(counts: &mut [u32]) {
    let mut sum = 0;
    counts[0] = 0;
    for count in counts {
        sum += *count;
        *count = sum;
    }
}

/// Working memory of the sort of a tile.
#[derive(Default)]
struct TileSort {
    entries: Vec<TileEntry>,
    /// The depth's bits, and the position among the entries.
    order: Vec<(u32, u32)>,
    swap: Vec<(u32, u32)>,
}

impl TileSort {
    /// Sorts the entries of one tile by depth; those of equal depth stay in their order.
    fn sort(&mut self, tile: &mut [TileEntry], depths: &[f32]) {
        self.entries.clear();
        self.entries.extend_from_slice(tile);
        // Depths are positive, so their bits are in the same order as they are.
        let keys = tile.iter().map(|entry| depths[entry.splat as usize].to_bits());
        self.order.clear();
        self.order.extend(keys.zip(0u32..));
        if self.order.len() < RADIX {
            // No two positions are equal, so this is stable.
            self.order.sort_unstable();
        } else {
            sort_by_key(&mut self.order, &mut self.swap);
        }
        for (to, &(_, from)) in tile.iter_mut().zip(&self.order) {
            *to = self.entries[from as usize];
        }
    }
}

/// Stable radix sort by the first number.
fn sort_by_key(items: &mut Vec<(u32, u32)>, swap: &mut Vec<(u32, u32)>) {
    swap.resize(items.len(), (0, 0));
    let mut counts = [[0u32; 256]; 4];
    for &(key, _) in items.iter() {
        for (counts, digit) in counts.iter_mut().zip(key.to_le_bytes()) {
            counts[usize::from(digit)] += 1;
        }
    }
    for (pass, counts) in counts.iter_mut().enumerate() {
        if counts.iter().any(|&count| count as usize == items.len()) {
            continue;
        }
        let mut sum = 0;
        for count in counts.iter_mut() {
            sum += std::mem::replace(count, sum);
        }
        for &item in items.iter() {
            let bucket = &mut counts[usize::from(item.0.to_le_bytes()[pass])];
            swap[*bucket as usize] = item;
            *bucket += 1;
        }
        std::mem::swap(items, swap);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_that_cannot_be_numbered_are_refused_with_their_number() {
        assert_eq!(numbered(&[u32::MAX - 3, 1, 2]), Ok(()));
        assert_eq!(numbered(&[u32::MAX - 3, 2, 2]), Err(1 << 32));
    }

    #[test]
    fn a_tile_is_sorted_by_depth_and_splats_of_equal_depth_keep_their_order() {
        let mut memory = TileSort::default();
        // The longer lists are sorted digit by digit; of the last, all depths are equal.
        for (count, depths) in [(0, 1), (1, 1), (RADIX - 1, 40), (RADIX, 40), (5000, 977), (RADIX, 1)] {
            let depth = |i: usize| 0.01 + (i * 7919 % depths) as f32 * 0.37;
            let depths: Vec<f32> = (0..2 * count).map(depth).collect();
            let entry = |i: usize| TileEntry { splat: 2 * i as u32, slot: 3 * i as u32 };
            let mut tile: Vec<TileEntry> = (0..count).map(entry).collect();
            let mut wanted = tile.clone();
            wanted.sort_by(|a, b| depths[a.splat as usize].total_cmp(&depths[b.splat as usize]));
            memory.sort(&mut tile, &depths);
            assert_eq!(tile, wanted, "{count} entries");
        }
    }
}
