//! Which splats touch which tiles, nearest first.
//!
//! Splats are sorted by depth once; dealing them out in that order leaves every tile's list sorted.

use super::project::{LOG2_ALPHA_MIN, Projector, SLACK, SplatFootprint};
use super::simd::{self, Isa, Simd, SimdKernel};
use rayon::prelude::*;
use segwild_scene::Splats;

/// Width of a tile in pixels.
pub(crate) const WIDTH: usize = 32;
/// Height of a tile in pixels.
pub(crate) const HEIGHT: usize = 16;
/// Splats that one task projects.
const CHUNK: usize = 512;

/// One splat in one tile.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TileEntry {
    /// The splat.
    pub splat: u32,
    /// Its index among all (splat, tile) pairs in the order of splats, then tiles.
    pub slot: u32,
}

/// A run of tiles in one row of tiles.
#[derive(Clone, Copy, Debug, Default)]
struct TileSpan {
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
    /// Per splat, where its spans start in its chunk's list, and how many there are.
    spans_of: Vec<(u32, u32)>,
    spans: Vec<Vec<TileSpan>>,
    order: Vec<(u32, u32)>,
    order_swap: Vec<(u32, u32)>,
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
        self.spans_of.resize(n, (0, 0));
        self.slots.resize(n + 1, 0);
        self.spans.resize_with(n.div_ceil(CHUNK), Vec::new);
        let counts = &mut self.slots[1..];
        self.depths
            .par_chunks_mut(CHUNK)
            .zip(self.radii.par_chunks_mut(CHUNK))
            .zip(self.centres.par_chunks_mut(CHUNK))
            .zip(self.footprints.par_chunks_mut(CHUNK))
            .zip(self.spans_of.par_chunks_mut(CHUNK))
            .zip(counts.par_chunks_mut(CHUNK))
            .zip(self.spans.par_iter_mut())
            .enumerate()
            .for_each(|(chunk, ((((((depths, radii), centres), prints), spans_of), counts), spans))| {
                let first = chunk * CHUNK;
                simd::run(
                    isa,
                    Chunk {
                        splats,
                        projector,
                        first,
                        depths,
                        radii,
                        centres,
                        prints,
                        spans_of,
                        counts,
                        spans,
                    },
                );
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
        self.order.clear();
        for i in 0..n {
            if self.slots[i + 1] > 0 {
                // Depths are positive, so their bits are in the same order as they are.
                self.order.push((self.depths[i].to_bits(), i as u32));
            }
        }
        prefix_sum(&mut self.slots);
        sort_by_key(&mut self.order, &mut self.order_swap);

        self.cursors.clear();
        self.cursors.extend_from_slice(&self.starts);
        self.entries.resize(self.slots[n] as usize, TileEntry { splat: 0, slot: 0 });
        for &(_, splat) in &self.order {
            let i = splat as usize;
            let mut slot = self.slots[i];
            let (first, count) = self.spans_of[i];
            for span in &self.spans[i / CHUNK][first as usize..(first + count) as usize] {
                let row = span.row as usize * self.columns;
                for cursor in &mut self.cursors[row + span.from as usize..=row + span.to as usize] {
                    self.entries[*cursor as usize] = TileEntry { splat, slot };
                    *cursor += 1;
                    slot += 1;
                }
            }
        }
        Ok(())
    }

    /// Entries of a tile, nearest first.
    pub fn tile(&self, tile: usize) -> &[TileEntry] {
        &self.entries[self.starts[tile] as usize..self.starts[tile + 1] as usize]
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
    spans_of: &'a mut [(u32, u32)],
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
            let first = self.spans.len();
            self.counts[k] = match self.projector.shape(self.splats, i) {
                Some(shape) => {
                    self.radii[k] = shape.radius;
                    self.prints[k] = shape.footprint;
                    cover(&shape.footprint, shape.tip, self.projector, self.spans)
                }
                None => 0,
            };
            self.spans_of[k] = (first as u32, (self.spans.len() - first) as u32);
        }
    }
}

/// Adds the tiles that hold a pixel centre of the ellipse where alpha reaches 1/255; returns their number.
#[inline(always)]
fn cover(f: &SplatFootprint, tip: f32, projector: &Projector, spans: &mut Vec<TileSpan>) -> u32 {
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

/// Stable radix sort by the first number.
fn sort_by_key(items: &mut Vec<(u32, u32)>, swap: &mut Vec<(u32, u32)>) {
    const BITS: u32 = 11;
    const BUCKETS: usize = 1 << BITS;
    swap.resize(items.len(), (0, 0));
    let mut counts = [[0u32; BUCKETS]; 3];
    for &(key, _) in items.iter() {
        for pass in 0..3 {
            counts[pass][(key >> (BITS * pass as u32)) as usize % BUCKETS] += 1;
        }
    }
    for pass in 0..3 {
        let counts = &mut counts[pass];
        if counts.iter().any(|&count| count as usize == items.len()) {
            continue;
        }
        let mut sum = 0;
        for count in counts.iter_mut() {
            sum += std::mem::replace(count, sum);
        }
        for &item in items.iter() {
            let bucket = &mut counts[(item.0 >> (BITS * pass as u32)) as usize % BUCKETS];
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
}
