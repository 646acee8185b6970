//! Forward, gather and backward over one tile.

use super::bin::{Bins, TileEntry};
use super::project::{Moments, SplatFootprint};
use super::simd::{LANES, Simd, SimdKernel};
use super::tile::{PLANE, PixelBlock, STRIDE, TileExtent, TilePlane, TileVisitor, copy_row, walk};
use std::marker::PhantomData;

/// Numbers per slot before the values: the fields of [`Moments`].
pub(crate) const MOMENTS: usize = 8;

/// A slice that tasks write at positions no other task touches.
#[derive(Clone, Copy)]
pub(crate) struct SharedSlice<'a> {
    data: *mut f32,
    len: usize,
    life: PhantomData<&'a mut [f32]>,
}

// SAFETY: it is only written through `part`, whose callers promise disjoint ranges.
unsafe impl Send for SharedSlice<'_> {}
// SAFETY: as above.
unsafe impl Sync for SharedSlice<'_> {}

impl<'a> SharedSlice<'a> {
    pub fn new(data: &'a mut [f32]) -> SharedSlice<'a> {
        SharedSlice { data: data.as_mut_ptr(), len: data.len(), life: PhantomData }
    }

    /// The `count` numbers from `at` on.
    ///
    /// # Safety
    /// No two tasks take overlapping parts, and no part is kept while another one that overlaps is taken.
    #[inline(always)]
    pub unsafe fn part(&self, at: usize, count: usize) -> &'a mut [f32] {
        assert!(at <= self.len && count <= self.len - at);
        // SAFETY: inside the slice by the assertion, exclusive by the caller's promise.
        unsafe { std::slice::from_raw_parts_mut(self.data.add(at), count) }
    }
}

/// What all kernels read: one tile of one view.
#[derive(Clone, Copy)]
pub(crate) struct Task<'a> {
    pub bins: &'a Bins,
    pub tile: usize,
    /// Of the frame, in pixels.
    pub width: usize,
    pub height: usize,
    /// `[splat][channel]`.
    pub values: &'a [f32],
    /// Channels per splat.
    pub count: usize,
}

impl Task<'_> {
    #[inline(always)]
    pub fn extent(&self) -> TileExtent {
        TileExtent::of(self.bins, self.tile, self.width, self.height)
    }

    /// Copies planes of an image.
    #[inline(always)]
    pub fn read(&self, image: &[f32], first: usize, into: &mut [TilePlane]) {
        let (extent, pixels) = (self.extent(), self.width * self.height);
        for (c, plane) in into.iter_mut().enumerate() {
            extent.read(&image[(first + c) * pixels..(first + c + 1) * pixels], self.width, plane);
        }
    }

    /// Writes one plane of an image.
    #[inline(always)]
    pub fn write(&self, image: &SharedSlice, plane: usize, from: &TilePlane) {
        let extent = self.extent();
        for row in 0..extent.height {
            let at = (plane * self.height + extent.y + row) * self.width + extent.x;
            // SAFETY: the tile owns its pixels in every plane.
            let to = unsafe { image.part(at, extent.width) };
            copy_row(to, &from.0[row * STRIDE..row * STRIDE + extent.width]);
        }
    }
}

/// Adds to eight numbers of a plane.
#[inline(always)]
pub(crate) fn accumulate<S: Simd>(s: S, plane: &mut TilePlane, at: usize, x: S::F) {
    // SAFETY: `at` comes from the walk, which promises eight numbers inside the plane.
    unsafe {
        let p = plane.0.as_mut_ptr().add(at);
        s.store(p, s.add(s.load(p), x));
    }
}

#[inline(always)]
fn load<S: Simd>(s: S, plane: &TilePlane, at: usize) -> S::F {
    // SAFETY: `at` comes from the walk, which promises eight numbers inside the plane.
    unsafe { s.load(plane.0.as_ptr().add(at)) }
}

/// Blends channels `first..first + C`.
pub(crate) struct Blend<'a, const C: usize> {
    pub task: Task<'a>,
    pub first: usize,
    pub image: SharedSlice<'a>,
    pub alpha: Option<SharedSlice<'a>>,
}

struct BlendVisit<'a, S: Simd, const C: usize> {
    values: &'a [f32],
    count: usize,
    first: usize,
    value: [S::F; C],
    planes: &'a mut [TilePlane; C],
    alpha: &'a mut TilePlane,
}

impl<S: Simd, const C: usize> TileVisitor<S> for BlendVisit<'_, S, C> {
    #[inline(always)]
    fn prepare(&mut self, s: S, entry: &TileEntry) {
        if let Some(value) = self.values.get(entry.splat as usize * self.count) {
            s.prefetch(value);
        }
    }

    #[inline(always)]
    fn start_splat(&mut self, s: S, entry: &TileEntry) {
        let at = entry.splat as usize * self.count + self.first;
        let values = &self.values[at..at + C];
        for c in 0..C {
            self.value[c] = s.splat(values[c]);
        }
    }

    #[inline(always)]
    fn block(&mut self, s: S, _: &SplatFootprint, b: &PixelBlock<S>) {
        accumulate(s, self.alpha, b.at, b.weight);
        for c in 0..C {
            accumulate(s, &mut self.planes[c], b.at, s.mul(b.weight, self.value[c]));
        }
    }
}

impl<const C: usize> SimdKernel for Blend<'_, C> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (mut planes, mut alpha) = ([TilePlane::ZERO; C], TilePlane::ZERO);
        let task = &self.task;
        let mut visit = BlendVisit::<S, C> {
            values: task.values,
            count: task.count,
            first: self.first,
            value: [s.splat(0.0); C],
            planes: &mut planes,
            alpha: &mut alpha,
        };
        walk(s, &task.bins.footprints, task.bins.tile(task.tile), &task.extent(), &mut visit);
        for c in 0..C {
            task.write(&self.image, self.first + c, &planes[c]);
        }
        if let Some(image) = &self.alpha {
            task.write(image, 0, &alpha);
        }
    }
}

/// `sum of alpha T image` for planes `first..first + C`, into the slots.
pub(crate) struct Gather<'a, const C: usize> {
    /// Its `values` are the image.
    pub task: Task<'a>,
    pub first: usize,
    /// `[slot][channel]`, all channels.
    pub slots: SharedSlice<'a>,
}

struct GatherVisit<'a, S: Simd, const C: usize> {
    sum: [S::F; C],
    planes: &'a [TilePlane; C],
    slots: SharedSlice<'a>,
    count: usize,
    first: usize,
}

impl<S: Simd, const C: usize> GatherVisit<'_, S, C> {
    #[inline(always)]
    fn write(&self, s: S, entry: &TileEntry) {
        // SAFETY: a slot belongs to one splat in one tile.
        let slot = unsafe { self.slots.part(entry.slot as usize * self.count + self.first, C) };
        for c in 0..C {
            slot[c] = s.sum(self.sum[c]);
        }
    }
}

impl<S: Simd, const C: usize> TileVisitor<S> for GatherVisit<'_, S, C> {
    #[inline(always)]
    fn start_splat(&mut self, s: S, _: &TileEntry) {
        self.sum = [s.splat(0.0); C];
    }

    #[inline(always)]
    fn block(&mut self, s: S, _: &SplatFootprint, b: &PixelBlock<S>) {
        for c in 0..C {
            self.sum[c] = s.add(self.sum[c], s.mul(b.weight, load(s, &self.planes[c], b.at)));
        }
    }

    #[inline(always)]
    fn end(&mut self, s: S, _: &SplatFootprint, entry: &TileEntry) {
        self.write(s, entry);
    }

    #[inline(always)]
    fn skip(&mut self, s: S, entry: &TileEntry) {
        self.sum = [s.splat(0.0); C];
        self.write(s, entry);
    }
}

impl<const C: usize> SimdKernel for Gather<'_, C> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let mut planes = [TilePlane::ZERO; C];
        let task = &self.task;
        task.read(task.values, self.first, &mut planes);
        let mut visit = GatherVisit::<S, C> {
            sum: [s.splat(0.0); C],
            planes: &planes,
            slots: self.slots,
            count: task.count,
            first: self.first,
        };
        walk(s, &task.bins.footprints, task.bins.tile(task.tile), &task.extent(), &mut visit);
    }
}

/// Gradients of a tile's splats, into the slots: [`MOMENTS`] numbers, then the values'.
///
/// Front to back, like the forward pass, with the same light per pixel. The contribution of farther splats is the total
/// minus what has been passed: no division by `1 - alpha` ever builds up. `C` is the number of channels, or 0 for any
/// number, then kept in memory.
pub(crate) struct Backward<'a, const C: usize> {
    pub task: Task<'a>,
    /// The forward pass's result and the gradients with respect to it.
    pub image: &'a [f32],
    pub alpha: &'a [f32],
    pub grad_image: &'a [f32],
    pub grad_alpha: Option<&'a [f32]>,
    /// `[slot][moments, channels]`.
    pub slots: SharedSlice<'a>,
    /// For `C` = 0: planes of the tile and sums of the values, as many as channels.
    pub spill: &'a mut Spill,
}

/// Working memory of [`Backward`] for any number of channels.
#[derive(Default)]
pub(crate) struct Spill {
    planes: Vec<TilePlane>,
    sums: Vec<[f32; LANES]>,
}

struct BackwardVisit<'a, S: Simd, const C: usize> {
    values: &'a [f32],
    count: usize,
    value: [S::F; C],
    value_any: &'a [f32],
    /// Gradients with respect to the planes and to alpha.
    grads: &'a [TilePlane],
    grad_alpha: &'a TilePlane,
    /// Gradient times the contribution of splats still to come, farther away.
    remaining: &'a mut TilePlane,
    slots: SharedSlice<'a>,
    sums: [S::F; C],
    sums_any: &'a mut [[f32; LANES]],
    dy: f32,
    row: [S::F; 3],
    moments: [S::F; MOMENTS],
}

impl<S: Simd, const C: usize> TileVisitor<S> for BackwardVisit<'_, S, C> {
    #[inline(always)]
    fn prepare(&mut self, s: S, entry: &TileEntry) {
        if let Some(value) = self.values.get(entry.splat as usize * self.count) {
            s.prefetch(value);
        }
    }

    #[inline(always)]
    fn start_splat(&mut self, s: S, entry: &TileEntry) {
        let at = entry.splat as usize * self.count;
        let values = &self.values[at..at + self.count];
        if C > 0 {
            for c in 0..C {
                self.value[c] = s.splat(values[c]);
            }
        } else {
            self.value_any = &self.values[at..at + self.count];
            self.sums_any.fill([0.0; LANES]);
        }
        self.sums = [s.splat(0.0); C];
        self.moments = [s.splat(0.0); MOMENTS];
    }

    #[inline(always)]
    fn row(&mut self, s: S, dy: f32) {
        self.dy = dy;
        self.row = [s.splat(0.0); 3];
    }

    #[inline(always)]
    fn block(&mut self, s: S, f: &SplatFootprint, b: &PixelBlock<S>) {
        let mut d = load(s, self.grad_alpha, b.at);
        if C > 0 {
            for c in 0..C {
                let g = load(s, &self.grads[c], b.at);
                d = s.add(d, s.mul(g, self.value[c]));
                self.sums[c] = s.add(self.sums[c], s.mul(b.weight, g));
            }
        } else {
            for ((plane, &value), sum) in self.grads.iter().zip(self.value_any).zip(self.sums_any.iter_mut())
            {
                let g = load(s, plane, b.at);
                d = s.add(d, s.mul(g, s.splat(value)));
                // SAFETY: `sum` has eight numbers.
                unsafe { s.store(sum.as_mut_ptr(), s.add(s.load(sum.as_ptr()), s.mul(b.weight, g))) };
            }
        }
        let passed = s.mul(b.weight, d);
        let remaining = s.sub(load(s, self.remaining, b.at), passed);
        // SAFETY: `at` comes from the walk, which promises eight numbers inside the plane.
        unsafe { s.store(self.remaining.0.as_mut_ptr().add(b.at), remaining) };

        // dL/d ln alpha = w d - alpha / (1 - alpha) remaining.
        let odds = s.div(b.alpha, s.sub(s.splat(1.0), b.alpha));
        let g = s.keep(s.sub(passed, s.mul(odds, remaining)), s.both(b.hit, b.free));
        let gu = s.mul(g, b.u);
        self.row[0] = s.add(self.row[0], g);
        self.row[1] = s.add(self.row[1], gu);
        self.row[2] = s.add(self.row[2], s.mul(gu, b.u));
        // The gradient of the centre, up to the factor 2 / log2 e that `end` puts on.
        let x = s.mul(gu, s.splat(f.a));
        let y = s.sub(s.mul(g, s.splat(f.e * self.dy)), s.mul(x, s.splat(f.slope)));
        self.moments[6] = s.add(self.moments[6], s.abs(x));
        self.moments[7] = s.add(self.moments[7], s.abs(y));
    }

    #[inline(always)]
    fn row_end(&mut self, s: S) {
        let dy = s.splat(self.dy);
        let m = &mut self.moments;
        let [g, gu, guu] = self.row;
        let gy = s.mul(g, dy);
        m[0] = s.add(m[0], g);
        m[1] = s.add(m[1], gu);
        m[2] = s.add(m[2], guu);
        m[3] = s.add(m[3], gy);
        m[4] = s.add(m[4], s.mul(gu, dy));
        m[5] = s.add(m[5], s.mul(gy, dy));
    }

    #[inline(always)]
    fn end(&mut self, s: S, _: &SplatFootprint, entry: &TileEntry) {
        const BASE: f32 = 2.0 * std::f32::consts::LN_2;
        let stride = MOMENTS + self.count;
        // SAFETY: a slot belongs to one splat in one tile.
        let slot = unsafe { self.slots.part(entry.slot as usize * stride, stride) };
        for k in 0..6 {
            slot[k] = s.sum(self.moments[k]);
        }
        slot[6] = BASE * s.sum(self.moments[6]);
        slot[7] = BASE * s.sum(self.moments[7]);
        if C > 0 {
            for c in 0..C {
                slot[MOMENTS + c] = s.sum(self.sums[c]);
            }
        } else {
            for (out, sum) in slot[MOMENTS..].iter_mut().zip(self.sums_any.iter()) {
                // SAFETY: `sum` has eight numbers.
                *out = s.sum(unsafe { s.load(sum.as_ptr()) });
            }
        }
    }

    #[inline(always)]
    fn skip(&mut self, _: S, entry: &TileEntry) {
        let stride = MOMENTS + self.count;
        // SAFETY: a slot belongs to one splat in one tile.
        unsafe { self.slots.part(entry.slot as usize * stride, stride) }.fill(0.0);
    }
}

impl<const C: usize> SimdKernel for Backward<'_, C> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let task = &self.task;
        let (extent, count) = (task.extent(), task.count);
        let mut fixed = [TilePlane::ZERO; C];
        let grads: &mut [TilePlane] = if C > 0 {
            &mut fixed
        } else {
            self.spill.planes.resize(count, TilePlane::ZERO);
            self.spill.sums.resize(count, [0.0; LANES]);
            &mut self.spill.planes
        };
        task.read(self.grad_image, 0, grads);
        let (mut grad_alpha, mut remaining, mut plane) = (TilePlane::ZERO, TilePlane::ZERO, TilePlane::ZERO);
        if let Some(grad) = self.grad_alpha {
            extent.read(grad, task.width, &mut grad_alpha);
            extent.read(self.alpha, task.width, &mut plane);
            for k in 0..PLANE {
                remaining.0[k] = plane.0[k] * grad_alpha.0[k];
            }
        }
        let pixels = task.width * task.height;
        for (c, grad) in grads.iter().enumerate() {
            extent.read(&self.image[c * pixels..(c + 1) * pixels], task.width, &mut plane);
            for row in 0..extent.height {
                for k in row * STRIDE..row * STRIDE + extent.width {
                    remaining.0[k] += plane.0[k] * grad.0[k];
                }
            }
        }
        let mut visit = BackwardVisit::<S, C> {
            values: task.values,
            count,
            value: [s.splat(0.0); C],
            value_any: &[],
            grads,
            grad_alpha: &grad_alpha,
            remaining: &mut remaining,
            slots: self.slots,
            sums: [s.splat(0.0); C],
            sums_any: &mut self.spill.sums,
            dy: 0.0,
            row: [s.splat(0.0); 3],
            moments: [s.splat(0.0); MOMENTS],
        };
        walk(s, &task.bins.footprints, task.bins.tile(task.tile), &extent, &mut visit);
    }
}

/// Sum of a splat's slots, in the order of tiles; returns its moments and adds the values'.
#[inline(always)]
pub(crate) fn sum_slots(slots: &[f32], from: u32, to: u32, values: &mut [f32]) -> Moments {
    let stride = MOMENTS + values.len();
    let mut m = [0.0; MOMENTS];
    for slot in slots[from as usize * stride..to as usize * stride].chunks_exact(stride) {
        for (sum, x) in m.iter_mut().zip(slot) {
            *sum += x;
        }
        for (sum, x) in values.iter_mut().zip(&slot[MOMENTS..]) {
            *sum += x;
        }
    }
    let [g, g_u, g_uu, g_y, g_uy, g_yy, abs_x, abs_y] = m;
    Moments { g, g_u, g_uu, g_y, g_uy, g_yy, abs_x, abs_y }
}
