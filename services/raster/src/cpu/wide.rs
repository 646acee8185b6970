//! Blending and gathering many channels: first the weights of a tile, once; then SIMD over channels.
//!
//! With few channels the lanes are pixels. With many, most of the time would go into lanes that a small splat
//! does not reach, and into storing planes; so the weights `alpha T` are written down as runs of pixels, and
//! every run is worked off with the channels of a pixel side by side.

use super::bin::{HEIGHT, TileEntry, WIDTH};
use super::kernels::{SharedSlice, Task, accumulate};
use super::project::SplatFootprint;
use super::simd::{LANES, Simd, SimdKernel};
use super::tile::{PixelBlock, STRIDE, TilePlane, TileVisitor, walk};

/// From this many channels on it pays.
pub(crate) const WIDE: usize = 8;
/// Channels worked off at a time: a tile of them fills the first-level cache, four registers hold them.
pub(crate) const BLOCK: usize = 4 * LANES;
/// Most blocks of pixels of one splat in one tile.
const MOST: usize = HEIGHT * (WIDTH / LANES);

/// Neighbouring pixels of one row under one splat.
#[derive(Clone, Copy, Default)]
struct PixelRun {
    /// First pixel, row-major in the tile.
    pixel: u16,
    count: u16,
    /// Where its weights are.
    weights: u32,
}

/// Weights of one tile, and planes with the channels side by side.
#[derive(Default)]
pub(crate) struct TileWeights {
    runs: Vec<PixelRun>,
    weights: Vec<f32>,
    /// Per entry, where its runs end; entries that no light reached are not listed.
    ends: Vec<u32>,
    /// `[pixel][channel of the block]`.
    pixels: Vec<[f32; BLOCK]>,
}

struct Collect<'a> {
    runs: &'a mut Vec<PixelRun>,
    weights: &'a mut Vec<f32>,
    ends: &'a mut Vec<u32>,
    used: usize,
    alpha: &'a mut TilePlane,
}

impl<S: Simd> TileVisitor<S> for Collect<'_> {
    #[inline(always)]
    fn start_splat(&mut self, _: S, _: &TileEntry) {
        if self.weights.len() < self.used + MOST * LANES {
            self.weights.resize(2 * (self.used + MOST * LANES), 0.0);
        }
        self.runs.reserve(MOST);
    }

    #[inline(always)]
    fn block(&mut self, s: S, _: &SplatFootprint, b: &PixelBlock<S>) {
        accumulate(s, self.alpha, b.at, b.weight);
        let bits = s.bits(b.hit);
        if bits == 0 {
            return;
        }
        // From the first blended pixel to the last: pixels in between without light have weight 0.
        let (first, end) = (bits.trailing_zeros(), 32 - bits.leading_zeros());
        let to: &mut [f32; LANES] = self.weights[self.used..].first_chunk_mut().expect("room was made");
        // SAFETY: `to` has eight numbers.
        unsafe { s.store(to.as_mut_ptr(), b.weight) };
        let (row, column) = (b.at / STRIDE, b.at % STRIDE);
        self.runs.push(PixelRun {
            pixel: (row * WIDTH + column) as u16 + first as u16,
            count: (end - first) as u16,
            weights: self.used as u32 + first,
        });
        self.used += LANES;
    }

    #[inline(always)]
    fn end(&mut self, _: S, _: &SplatFootprint, _: &TileEntry) {
        self.ends.push(self.runs.len() as u32);
    }
}

impl TileWeights {
    #[inline(always)]
    fn collect<S: Simd>(&mut self, s: S, task: &Task, alpha: &mut TilePlane) {
        self.runs.clear();
        self.ends.clear();
        self.pixels.resize(HEIGHT * WIDTH, [0.0; BLOCK]);
        let TileWeights { runs, weights, ends, .. } = self;
        let mut visit = Collect { runs, weights, ends, used: 0, alpha };
        walk(s, &task.bins.footprints, task.bins.tile(task.tile), &task.extent(), &mut visit);
    }
}

/// A block of channels as four registers.
type Four<S> = [<S as Simd>::F; 4];

#[inline(always)]
fn load_four<S: Simd>(s: S, from: &[f32; BLOCK]) -> Four<S> {
    let p = from.as_ptr();
    // SAFETY: BLOCK = 4 LANES.
    unsafe { [s.load(p), s.load(p.add(LANES)), s.load(p.add(2 * LANES)), s.load(p.add(3 * LANES))] }
}

#[inline(always)]
fn store_four<S: Simd>(s: S, to: &mut [f32; BLOCK], x: Four<S>) {
    let p = to.as_mut_ptr();
    for k in 0..4 {
        // SAFETY: BLOCK = 4 LANES.
        unsafe { s.store(p.add(k * LANES), x[k]) };
    }
}

#[inline(always)]
fn add_product<S: Simd>(s: S, sum: Four<S>, weight: f32, x: Four<S>) -> Four<S> {
    let w = s.splat(weight);
    [
        s.add(sum[0], s.mul(w, x[0])),
        s.add(sum[1], s.mul(w, x[1])),
        s.add(sum[2], s.mul(w, x[2])),
        s.add(sum[3], s.mul(w, x[3])),
    ]
}

/// Blends any number of channels.
pub(crate) struct BlendWide<'a> {
    pub task: Task<'a>,
    pub image: SharedSlice<'a>,
    pub alpha: SharedSlice<'a>,
    pub memory: &'a mut TileWeights,
}

impl SimdKernel for BlendWide<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (task, memory) = (&self.task, self.memory);
        let mut plane = TilePlane::ZERO;
        memory.collect(s, task, &mut plane);
        task.write(&self.alpha, 0, &plane);
        let entries = task.bins.tile(task.tile);
        let mut first = 0;
        while first < task.count {
            let channels = BLOCK.min(task.count - first);
            memory.pixels.fill([0.0; BLOCK]);
            let pixels = memory.pixels.as_mut_slice();
            let mut from = 0;
            for (entry, &end) in entries.iter().zip(&memory.ends) {
                let at = entry.splat as usize * task.count + first;
                let mut values = [0.0; BLOCK];
                values[..channels].copy_from_slice(&task.values[at..at + channels]);
                let values = load_four(s, &values);
                for run in &memory.runs[from..end as usize] {
                    let (weights, pixel) = (run.weights as usize, run.pixel as usize);
                    let count = run.count as usize;
                    let weights = &memory.weights[weights..weights + count];
                    for (pixel, &weight) in pixels[pixel..pixel + count].iter_mut().zip(weights) {
                        store_four(s, pixel, add_product(s, load_four(s, pixel), weight, values));
                    }
                }
                from = end as usize;
            }
            for c in 0..channels {
                for (row, to) in plane.0.chunks_exact_mut(STRIDE).enumerate() {
                    for (x, to) in to[..WIDTH].iter_mut().enumerate() {
                        *to = pixels[row * WIDTH + x][c];
                    }
                }
                task.write(&self.image, first + c, &plane);
            }
            first += channels;
        }
    }
}

/// `sum of alpha T image` for any number of planes, into the slots.
pub(crate) struct GatherWide<'a> {
    /// Its `values` are the image.
    pub task: Task<'a>,
    /// `[slot][channel]`.
    pub slots: SharedSlice<'a>,
    pub memory: &'a mut TileWeights,
}

impl SimdKernel for GatherWide<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (task, memory) = (&self.task, self.memory);
        let mut plane = TilePlane::ZERO;
        memory.collect(s, task, &mut plane);
        let entries = task.bins.tile(task.tile);
        let mut first = 0;
        while first < task.count {
            let channels = BLOCK.min(task.count - first);
            for c in 0..channels {
                task.read(task.values, first + c, std::slice::from_mut(&mut plane));
                for (row, from) in plane.0.chunks_exact(STRIDE).enumerate() {
                    for (x, &from) in from[..WIDTH].iter().enumerate() {
                        memory.pixels[row * WIDTH + x][c] = from;
                    }
                }
            }
            let pixels = memory.pixels.as_slice();
            let mut from = 0;
            for (k, entry) in entries.iter().enumerate() {
                let end = memory.ends.get(k).map_or(from, |&end| end as usize);
                let mut sum = [s.splat(0.0); 4];
                for run in &memory.runs[from..end] {
                    let (weights, pixel) = (run.weights as usize, run.pixel as usize);
                    let count = run.count as usize;
                    let weights = &memory.weights[weights..weights + count];
                    for (pixel, &weight) in pixels[pixel..pixel + count].iter().zip(weights) {
                        sum = add_product(s, sum, weight, load_four(s, pixel));
                    }
                }
                from = end;
                let mut numbers = [0.0; BLOCK];
                store_four(s, &mut numbers, sum);
                // SAFETY: a slot belongs to one splat in one tile.
                let slot = unsafe { self.slots.part(entry.slot as usize * task.count + first, channels) };
                slot.copy_from_slice(&numbers[..channels]);
            }
            first += channels;
        }
    }
}
