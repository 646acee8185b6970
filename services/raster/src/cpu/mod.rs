//! The CPU engine: tiles over rayon, SIMD over pixels.
//!
//! The same bytes whatever the number of threads and the instruction set: every tile works alone, its result for a
//! splat goes to a slot of its own, and a splat's slots are summed in the order of tiles.

mod bin;
mod front;
mod kernels;
mod project;
pub mod simd;
mod tile;
mod wide;

pub use front::{FrontLayer, NONE as NO_SPLAT};
pub use project::{ALPHA_MAX, ALPHA_MIN, LOG2_ALPHA_MIN, SLACK, T_MIN, jacobian_limits};
pub use simd::Isa;

use crate::engine::check;
use crate::shade::{shade, shade_backward};
use crate::{Channels, Frame, FrameGrad, ProjectOptions, Projected, RasterError, Rasterizer, SplatGrads};
use bin::Bins;
use front::Front;
use glam::Vec3;
use kernels::{Backward, Blend, Gather, MOMENTS, SharedSlice, Spill, Task, sum_slots};
use project::Projector;
use rayon::prelude::*;
use segwild_scene::{Camera, Image, Pose, Splats};
use std::sync::{Mutex, MutexGuard, PoisonError};
use wide::{BLOCK, BlendWide, GatherWide, TileWeights, WIDE};

/// Splats that one task sums or shades.
const CHUNK: usize = 512;
/// Numbers that the slots of a gather hold at once (1 GiB), unless one block of channels takes more.
const GATHERED: usize = 1 << 28;

/// A pool of buffers, reused by later passes.
struct Pool<T> {
    kept: Mutex<Vec<T>>,
    /// Buffers that are kept while none is in use.
    most: usize,
}

impl<T: Default> Pool<T> {
    fn of(most: usize) -> Pool<T> {
        Pool { kept: Mutex::default(), most }
    }

    fn kept(&self) -> MutexGuard<'_, Vec<T>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take(&self) -> T {
        self.kept().pop().unwrap_or_default()
    }

    fn give(&self, memory: T) {
        let mut kept = self.kept();
        if kept.len() < self.most {
            kept.push(memory);
        }
    }

    fn bytes(&self, of: impl Fn(&T) -> usize) -> usize {
        self.kept().iter().map(of).sum()
    }
}

/// The rasteriser for CPUs. Make one and keep it: its memory is used again from view to view.
pub struct CpuEngine {
    isa: Isa,
    bins: Pool<Bins>,
    /// Held during a pass only: views are kept by the dozen, and slots of many channels are most of what one would hold.
    slots: Pool<Vec<f32>>,
}

impl Default for CpuEngine {
    fn default() -> CpuEngine {
        CpuEngine::new()
    }
}

impl CpuEngine {
    /// An engine on the widest instruction set of this processor (see [`Isa::detect`]).
    pub fn new() -> CpuEngine {
        CpuEngine::with_isa(Isa::detect())
    }

    /// An engine on one instruction set; the plain one if the processor lacks it.
    pub fn with_isa(isa: Isa) -> CpuEngine {
        let isa = if isa.available() { isa } else { Isa::Plain };
        CpuEngine { isa, bins: Pool::of(usize::MAX), slots: Pool::of(usize::MAX) }
    }

    /// The same; it keeps the memory of at most so many views at a time, however many were in use at once.
    #[must_use]
    pub fn keeping(self, most: usize) -> CpuEngine {
        CpuEngine { bins: Pool::of(most), slots: Pool::of(most), ..self }
    }

    /// The instruction set in use.
    pub fn isa(&self) -> Isa {
        self.isa
    }

    fn view<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<CpuView<'a>, RasterError> {
        check(splats, camera)?;
        let projector = Projector::new(camera, pose, options);
        let mut bins = self.bins.take();
        bins.fill(self.isa, splats, &projector).map_err(|pairs| {
            RasterError::Shape(format!(
                "{pairs} pairs of a splat and a tile are more than can be numbered: render smaller frames or fewer splats"
            ))
        })?;
        Ok(CpuView { engine: self, splats, projector, eye: pose.centre(), bins })
    }

    /// The front layer of one view. Of equal shares the nearer splat's counts, and a splat's first pixel by tiles.
    ///
    /// # Errors
    /// As [`Engine::project`].
    pub fn front(
        &self,
        splats: &Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<FrontLayer, RasterError> {
        Ok(self.view(splats, camera, pose, options)?.front())
    }

    /// The same, and the view that it is of, which other passes need not project again.
    ///
    /// # Errors
    /// As [`Rasterizer::project`].
    pub fn project_with_front<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<(Box<dyn Projected + 'a>, FrontLayer), RasterError> {
        let view = self.view(splats, camera, pose, options)?;
        let front = view.front();
        let projected: Box<dyn Projected + 'a> = Box::new(view);
        Ok((projected, front))
    }
}

impl Rasterizer for CpuEngine {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn is_on_host(&self) -> bool {
        true
    }

    fn kept_bytes(&self) -> usize {
        self.bins.bytes(Bins::bytes) + self.slots.bytes(|slots| size_of::<f32>() * slots.capacity())
    }

    fn project<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError> {
        Ok(Box::new(self.view(splats, camera, pose, options)?))
    }
}

/// Splats as one view sees them, dealt to tiles.
struct CpuView<'a> {
    engine: &'a CpuEngine,
    splats: &'a Splats,
    projector: Projector,
    eye: Vec3,
    bins: Bins,
}

impl Drop for CpuView<'_> {
    fn drop(&mut self) {
        self.engine.bins.give(std::mem::take(&mut self.bins));
    }
}

impl CpuView<'_> {
    fn tiles(&self) -> usize {
        self.bins.columns * self.bins.rows
    }

    fn task<'a>(&'a self, tile: usize, values: &'a [f32], count: usize) -> Task<'a> {
        Task {
            bins: &self.bins,
            tile,
            width: self.projector.width,
            height: self.projector.height,
            values,
            count,
        }
    }

    /// Runs with slots of `stride` numbers each, which hold anything.
    fn with_slots<T>(&self, stride: usize, work: impl FnOnce(&mut [f32]) -> T) -> T {
        let mut held = self.engine.slots.take();
        let len = self.bins.pairs() * stride;
        if held.len() < len {
            held.resize(len, 0.0);
        }
        let out = work(&mut held[..len]);
        self.engine.slots.give(held);
        out
    }

    fn front(&self) -> FrontLayer {
        let (width, height) = (self.projector.width, self.projector.height);
        let pixels = width * height;
        // Accumulated alpha, then splats as bits.
        let mut planes = vec![0.0; 2 * pixels];
        let n = self.splats.len();
        let (mut best, mut shares) = (vec![NO_SPLAT; n], vec![0.0; n]);
        self.with_slots(front::NUMBERS, |slots| {
            let (image, shared) = (SharedSlice::new(&mut planes), SharedSlice::new(slots));
            (0..self.tiles()).into_par_iter().for_each(|tile| {
                let task = self.task(tile, &[], 0);
                simd::run(self.engine.isa, Front { task, image, slots: shared });
            });
            let results = best.par_iter_mut().zip(&mut shares).enumerate().with_min_len(CHUNK);
            results.for_each(|(i, (pixel, share))| {
                let (from, to) = (self.bins.slots[i] as usize, self.bins.slots[i + 1] as usize);
                for slot in slots[from * front::NUMBERS..to * front::NUMBERS].chunks_exact(front::NUMBERS) {
                    if slot[0] > *share {
                        (*share, *pixel) = (slot[0], slot[1].to_bits());
                    }
                }
            });
        });
        let splats = planes[pixels..].iter().map(|bits| bits.to_bits()).collect();
        planes.truncate(pixels);
        let alpha = Image { width, height, channels: 1, data: planes };
        FrontLayer { width, height, splats, pixels: best, shares, alpha }
    }

    /// Adds the sums of an image to `out`, `[splat][channel]`, by `at_once` channels: a multiple of [`BLOCK`], or all.
    fn gather_in_parts(&self, image: &Image, at_once: usize, out: &mut [f32]) {
        let (count, pixels) = (image.channels, image.width * image.height);
        for first in (0..count).step_by(at_once.max(1)) {
            let part = first..count.min(first + at_once);
            let (planes, many) = (&image.data[part.start * pixels..part.end * pixels], part.len());
            self.with_slots(many, |slots| {
                self.gather_planes(planes, many, count >= WIDE, SharedSlice::new(slots));
                out.par_chunks_mut(CHUNK * count).enumerate().for_each(|(chunk, out)| {
                    for (k, out) in out.chunks_exact_mut(count).enumerate() {
                        let i = chunk * CHUNK + k;
                        let (from, to) = (self.bins.slots[i] as usize, self.bins.slots[i + 1] as usize);
                        for slot in slots[from * many..to * many].chunks_exact(many) {
                            for (sum, x) in out[part.clone()].iter_mut().zip(slot) {
                                *sum += x;
                            }
                        }
                    }
                });
            });
        }
    }

    /// Sums of `count` planes per splat and tile, into the slots: by channels where `wide`, else by pixels.
    fn gather_planes(&self, planes: &[f32], count: usize, wide: bool, slots: SharedSlice) {
        (0..self.tiles()).into_par_iter().for_each_init(TileWeights::default, |memory, tile| {
            let (isa, task) = (self.engine.isa, self.task(tile, planes, count));
            if wide {
                return simd::run(isa, GatherWide { task, slots, memory });
            }
            let mut first = 0;
            while first < count {
                let left = count - first;
                match left {
                    1 => simd::run(isa, Gather::<1> { task, first, slots }),
                    2 => simd::run(isa, Gather::<2> { task, first, slots }),
                    3 => simd::run(isa, Gather::<3> { task, first, slots }),
                    _ => simd::run(isa, Gather::<4> { task, first, slots }),
                }
                first += left.min(4);
            }
        });
    }

    fn assert_image(&self, image: &Image, channels: usize, what: &str) {
        let size = (image.width, image.height, image.channels);
        let wanted = (self.projector.width, self.projector.height, channels);
        assert_eq!(size, wanted, "{what}: width, height, channels");
        assert_eq!(image.data.len(), image.width * image.height * image.channels, "{what}: numbers");
    }
}

/// How many of `count` channels a gather over so many pairs of a splat and a tile sums at once, so that its slots stay
/// within [`GATHERED`].
fn gathered_at_once(pairs: usize, count: usize) -> usize {
    let most = GATHERED / pairs.max(1);
    if count <= most { count } else { (most / BLOCK).max(1) * BLOCK }
}

impl Projected for CpuView<'_> {
    fn depths(&self) -> &[f32] {
        &self.bins.depths
    }

    fn radii(&self) -> &[f32] {
        &self.bins.radii
    }

    fn centres(&self) -> &[[f32; 2]] {
        &self.bins.centres
    }

    fn shade(&self) -> Vec<f32> {
        shade(self.splats, self.eye, &self.bins.radii)
    }

    fn blend(&self, channels: &Channels) -> Result<Frame, RasterError> {
        let Channels { count, values } = *channels;
        assert_eq!(values.len(), self.splats.len() * count, "channels: values");
        let (width, height) = (self.projector.width, self.projector.height);
        let mut image = Image::zeros(width, height, count);
        let mut alpha = Image::zeros(width, height, 1);
        let (planes, opacity) = (SharedSlice::new(&mut image.data), SharedSlice::new(&mut alpha.data));
        (0..self.tiles()).into_par_iter().for_each_init(TileWeights::default, |memory, tile| {
            let task = self.task(tile, values, count);
            if count >= WIDE {
                let wide = BlendWide { task, image: planes, alpha: opacity, memory };
                return simd::run(self.engine.isa, wide);
            }
            let mut first = 0;
            loop {
                let alpha = (first == 0).then_some(opacity);
                let isa = self.engine.isa;
                let left = count - first;
                match left {
                    0 if first > 0 => break,
                    0 => simd::run(isa, Blend::<0> { task, first, image: planes, alpha }),
                    1 => simd::run(isa, Blend::<1> { task, first, image: planes, alpha }),
                    2 => simd::run(isa, Blend::<2> { task, first, image: planes, alpha }),
                    3 => simd::run(isa, Blend::<3> { task, first, image: planes, alpha }),
                    _ => simd::run(isa, Blend::<4> { task, first, image: planes, alpha }),
                }
                first += left.min(4);
                if first == count {
                    break;
                }
            }
        });
        Ok(Frame { image, alpha })
    }

    fn gather(&self, image: &Image) -> Result<Vec<f32>, RasterError> {
        let count = image.channels;
        self.assert_image(image, count, "gather");
        let mut out = vec![0.0; self.splats.len() * count];
        self.gather_in_parts(image, gathered_at_once(self.bins.pairs(), count), &mut out);
        Ok(out)
    }

    fn backward(
        &self,
        channels: &Channels,
        frame: &Frame,
        grad: &FrameGrad,
    ) -> Result<SplatGrads, RasterError> {
        let Channels { count, values } = *channels;
        let n = self.splats.len();
        assert_eq!(values.len(), n * count, "channels: values");
        self.assert_image(&frame.image, count, "frame");
        self.assert_image(&frame.alpha, 1, "frame's alpha");
        self.assert_image(grad.image, count, "gradient");
        if let Some(alpha) = grad.alpha {
            self.assert_image(alpha, 1, "gradient of alpha");
        }
        let mut out = SplatGrads {
            means: vec![[0.0; 3]; n],
            log_scales: vec![[0.0; 3]; n],
            rotations: vec![[0.0; 4]; n],
            opacities: vec![0.0; n],
            values: vec![0.0; n * count],
            screen: vec![0.0; n],
            screen_abs: vec![0.0; n],
        };
        self.with_slots(MOMENTS + count, |slots| {
            let shared = SharedSlice::new(slots);
            (0..self.tiles()).into_par_iter().for_each_init(Spill::default, |spill, tile| {
                macro_rules! backward {
                    ($channels:literal) => {
                        simd::run(
                            self.engine.isa,
                            Backward::<$channels> {
                                task: self.task(tile, values, count),
                                image: &frame.image.data,
                                alpha: &frame.alpha.data,
                                grad_image: &grad.image.data,
                                grad_alpha: grad.alpha.map(|alpha| alpha.data.as_slice()),
                                slots: shared,
                                spill,
                            },
                        )
                    };
                }
                match count {
                    1 => backward!(1),
                    2 => backward!(2),
                    3 => backward!(3),
                    4 => backward!(4),
                    _ => backward!(0),
                }
            });
            let slots = &*slots;
            out.means
                .par_chunks_mut(CHUNK)
                .zip(out.log_scales.par_chunks_mut(CHUNK))
                .zip(out.rotations.par_chunks_mut(CHUNK))
                .zip(out.opacities.par_chunks_mut(CHUNK))
                .zip(out.screen.par_chunks_mut(CHUNK))
                .zip(out.screen_abs.par_chunks_mut(CHUNK))
                .zip(ValueRows::split(&mut out.values, CHUNK * count, n.div_ceil(CHUNK)))
                .enumerate()
                .for_each(
                    |(chunk, ((((((means, scales), turns), opacities), screen), screen_abs), values))| {
                        let (view, first) = (self, chunk * CHUNK);
                        simd::run(
                            self.engine.isa,
                            Unproject {
                                view,
                                slots,
                                first,
                                count,
                                means,
                                scales,
                                turns,
                                opacities,
                                screen,
                                screen_abs,
                                values,
                            },
                        );
                    },
                );
        });
        Ok(out)
    }

    fn shade_backward(&self, colours: &[f32], grads: &mut SplatGrads) -> Vec<f32> {
        shade_backward(self.splats, self.eye, &self.bins.radii, colours, grads)
    }
}

/// Sums the slots of the splats from `first` on and carries the sums back to the parameters.
struct Unproject<'a> {
    view: &'a CpuView<'a>,
    slots: &'a [f32],
    first: usize,
    count: usize,
    means: &'a mut [[f32; 3]],
    scales: &'a mut [[f32; 3]],
    turns: &'a mut [[f32; 4]],
    opacities: &'a mut [f32],
    screen: &'a mut [f32],
    screen_abs: &'a mut [f32],
    values: &'a mut [f32],
}

impl simd::SimdKernel for Unproject<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: simd::Simd>(self, _: S) {
        for k in 0..self.means.len() {
            let i = self.first + k;
            let (from, to) = (self.view.bins.slots[i], self.view.bins.slots[i + 1]);
            if from == to {
                continue;
            }
            let values = &mut self.values[k * self.count..(k + 1) * self.count];
            let moments = sum_slots(self.slots, from, to, values);
            let g = self.view.projector.backward(self.view.splats, i, &moments);
            self.means[k] = g.mean;
            self.scales[k] = g.log_scale;
            self.turns[k] = g.rotation;
            self.opacities[k] = g.opacity;
            self.screen[k] = g.screen;
            self.screen_abs[k] = g.screen_abs;
        }
    }
}

/// Chunks of a slice that may be empty: a blend of no channel has values of length 0 per splat.
struct ValueRows;

impl ValueRows {
    fn split(data: &mut [f32], size: usize, count: usize) -> impl IndexedParallelIterator<Item = &mut [f32]> {
        let mut parts = Vec::with_capacity(count);
        let mut rest = data;
        for _ in 0..count {
            let (part, tail) = rest.split_at_mut(size.min(rest.len()));
            parts.push(part);
            rest = tail;
        }
        parts.into_par_iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slots_of_a_gather_are_bounded_for_millions_of_pairs() {
        assert_eq!(gathered_at_once(0, 64), 64);
        assert_eq!(gathered_at_once(4_000_000, 64), 64);
        assert_eq!(gathered_at_once(20_000_000, 64), BLOCK, "one block at least");
        assert_eq!(gathered_at_once(20_000_000, 3), 3);
        for (pairs, count) in [(1 << 20, 384), (3_000_000, 128), (5_000_000, 1000)] {
            let at_once = gathered_at_once(pairs, count);
            assert!(at_once < count && at_once.is_multiple_of(BLOCK), "{at_once} of {count}");
            assert!(pairs * at_once <= GATHERED && pairs * (at_once + BLOCK) > GATHERED, "{at_once}");
        }
    }

    #[test]
    fn channels_gathered_in_parts_are_the_same_bytes() {
        let at = |i: usize, k: usize| ((i * 31 + k * 17) % 23) as f32 / 23.0 - 0.5;
        let n = 200;
        let splats = Splats {
            means: (0..n).map(|i| [at(i, 0), at(i, 1), 1.5 + at(i, 2)]).collect(),
            log_scales: (0..n).map(|i| [-3.5 + at(i, 3), -3.0, -4.0 + at(i, 4)]).collect(),
            rotations: (0..n).map(|i| [1.0, at(i, 5), at(i, 6), at(i, 7)]).collect(),
            opacities: (0..n).map(|i| 4.0 * at(i, 8)).collect(),
            sh: vec![0.0; 3 * n],
            ..Splats::default()
        };
        let camera = Camera { width: 70, height: 40, fx: 60.0, fy: 60.0, cx: 35.0, cy: 20.0 };
        let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
        let engine = CpuEngine::new();
        let options = ProjectOptions::default();
        let view = engine.view(&splats, &camera, &pose, &options).expect("it can be rendered");
        // The last part is narrower than what is gathered by pixels when it is alone.
        let count = 2 * BLOCK + 3;
        let data = (0..70 * 40 * count).map(|i| at(i, 9)).collect();
        let image = Image { width: 70, height: 40, channels: count, data };
        let [whole, parts] = [count, BLOCK].map(|at_once| {
            let mut out = vec![0.0; n * count];
            view.gather_in_parts(&image, at_once, &mut out);
            out
        });
        assert!(whole.iter().any(|&sum| sum != 0.0), "splats are in sight");
        let bits = |sums: &[f32]| sums.iter().map(|sum| sum.to_bits()).collect::<Vec<_>>();
        assert!(bits(&whole) == bits(&parts), "in parts and at once");
    }
}
