//! Which splat makes up most of each pixel, and in which pixel each splat makes up most.

use super::bin::TileEntry;
use super::kernels::{SharedSlice, Task, accumulate};
use super::project::SplatFootprint;
use super::simd::{LANES, Simd, SimdKernel};
use super::tile::{PLANE, PixelBlock, STRIDE, TilePlane, TileVisitor, walk};
use segwild_scene::Image;

/// No splat, or no pixel.
pub const NONE: u32 = u32::MAX;

/// Numbers per slot: the largest weight, and the pixel as bits.
pub(crate) const NUMBERS: usize = 2;

/// The front layer of a view. A splat's share of a pixel is its blending weight `alpha T`.
#[derive(Clone, Debug, PartialEq)]
pub struct FrontLayer {
    /// Pixels of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Per pixel, row by row, the splat with the largest share; [`NONE`] where there is no splat.
    pub splats: Vec<u32>,
    /// Per splat, the pixel of which it has its largest share; [`NONE`] where it shows in no pixel.
    pub pixels: Vec<u32>,
    /// Per splat, that share in [0, 1].
    pub shares: Vec<f32>,
    /// Per pixel, the sum of all shares: one plane.
    pub alpha: Image,
}

/// Fills a tile's part of a [`FrontLayer`].
pub(crate) struct Front<'a> {
    pub task: Task<'a>,
    /// Two planes: accumulated alpha, and the splat as bits.
    pub image: SharedSlice<'a>,
    /// `[slot][weight, pixel]`.
    pub slots: SharedSlice<'a>,
}

struct FrontVisit<'a> {
    weights: TilePlane,
    splats: [u32; PLANE],
    alpha: TilePlane,
    splat: u32,
    best: (f32, usize),
    slots: SharedSlice<'a>,
    /// First pixel of the tile, and pixels of a row of the frame.
    origin: usize,
    width: usize,
}

impl FrontVisit<'_> {
    #[inline(always)]
    fn write(&self, entry: &TileEntry, weight: f32, pixel: u32) {
        // SAFETY: a slot belongs to one splat in one tile.
        let slot = unsafe { self.slots.part(entry.slot as usize * NUMBERS, NUMBERS) };
        (slot[0], slot[1]) = (weight, f32::from_bits(pixel));
    }
}

impl<S: Simd> TileVisitor<S> for FrontVisit<'_> {
    #[inline(always)]
    fn start_splat(&mut self, _: S, entry: &TileEntry) {
        (self.splat, self.best) = (entry.splat, (0.0, 0));
    }

    #[inline(always)]
    fn block(&mut self, s: S, _: &SplatFootprint, b: &PixelBlock<S>) {
        accumulate(s, &mut self.alpha, b.at, b.weight);
        let mut weights = [0.0; LANES];
        // SAFETY: `weights` has eight numbers.
        unsafe { s.store(weights.as_mut_ptr(), b.weight) };
        for (at, &weight) in (b.at..b.at + LANES).zip(&weights) {
            if weight > self.weights.0[at] {
                self.weights.0[at] = weight;
                self.splats[at] = self.splat;
            }
            if weight > self.best.0 {
                self.best = (weight, at);
            }
        }
    }

    #[inline(always)]
    fn end(&mut self, _: S, _: &SplatFootprint, entry: &TileEntry) {
        let (weight, at) = self.best;
        let pixel = self.origin + at / STRIDE * self.width + at % STRIDE;
        self.write(entry, weight, if weight > 0.0 { pixel as u32 } else { NONE });
    }

    #[inline(always)]
    fn skip(&mut self, _: S, entry: &TileEntry) {
        self.write(entry, 0.0, NONE);
    }
}

impl SimdKernel for Front<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let task = &self.task;
        let extent = task.extent();
        let mut visit = FrontVisit {
            weights: TilePlane::ZERO,
            splats: [NONE; PLANE],
            alpha: TilePlane::ZERO,
            splat: NONE,
            best: (0.0, 0),
            slots: self.slots,
            origin: extent.y * task.width + extent.x,
            width: task.width,
        };
        walk(s, &task.bins.footprints, task.bins.tile(task.tile), &extent, &mut visit);
        task.write(&self.image, 0, &visit.alpha);
        let mut splats = TilePlane::ZERO;
        splats.0.iter_mut().zip(visit.splats).for_each(|(to, splat)| *to = f32::from_bits(splat));
        task.write(&self.image, 1, &splats);
    }
}
