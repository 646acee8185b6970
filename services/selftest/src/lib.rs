//! Finds the kernel that a device computes wrongly: compares each step of a frame with the CPU engine or a known
//! result, in the order in which the steps depend on one another. The first that diverges has the fault.

mod compare;
mod feature_case;
mod field;
mod networks;
mod training;

pub use compare::{TestCase, compared, test_cases};
pub use feature_case::{FeatureCase, FeatureCaseData};
pub use networks::{networks, some_appearance};
pub use training::{held, held_with_embeddings, training as check_training};

use glam::Vec3;
use segwild_gpu::probe::{ViewLists, running_sums, sorted, view_lists};
use segwild_gpu::{GpuEngine, GpuError};
use segwild_raster::{
    ALPHA_MAX, ALPHA_MIN, Channels, CpuEngine, Frame, FrameGrad, ProjectOptions, Projected, RasterError,
    Rasterizer, SplatGrads,
};
use segwild_scene::{Camera, Image, Pose, Random, Splats};

/// How far numbers may lie apart, in units of their size plus the array's root mean square.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    /// For all but a share.
    pub tight: f32,
    /// That share: values at a cut-off may fall on either side.
    pub flips: f32,
    /// For all.
    pub loose: f32,
}

impl Tolerance {
    /// Depths, radii, centres.
    pub const PROJECTED: Tolerance = Tolerance { tight: 1e-4, flips: 0.0, loose: 1e-4 };
    /// Images.
    pub const BLENDED: Tolerance = Tolerance { tight: 5e-5, flips: 0.01, loose: 0.02 };
    /// Sums over pixels.
    pub const GRADIENTS: Tolerance = Tolerance { tight: 5e-4, flips: 0.01, loose: 0.1 };

    /// Describes the difference if it exceeds the tolerance.
    pub fn compare(&self, what: &str, got: &[f32], wanted: &[f32]) -> Result<(), String> {
        if got.len() != wanted.len() {
            return Err(format!("{what}: {} numbers, not {}", got.len(), wanted.len()));
        }
        let squares = wanted.iter().map(|w| f64::from(*w).powi(2)).sum::<f64>();
        let rms = (squares / wanted.len().max(1) as f64).sqrt() as f32;
        let (mut flips, mut worst) = (0, (0.0, 0));
        for (i, (&g, &w)) in got.iter().zip(wanted).enumerate() {
            if !g.is_finite() {
                return Err(format!("{what}: number {i} is {g} where {w} is right"));
            }
            let error = (g - w).abs() / (w.abs() + rms + 1e-20);
            flips += usize::from(error > self.tight);
            if error > worst.0 {
                worst = (error, i);
            }
        }
        let (error, i) = worst;
        if error > self.loose {
            return Err(format!("{what}: number {i} is {} where {} is right", got[i], wanted[i]));
        }
        if flips > (self.flips * wanted.len() as f32).ceil() as usize {
            return Err(format!("{what}: {flips} of {} are off, the worst by {error}", wanted.len()));
        }
        Ok(())
    }
}

/// One step of a frame, compared.
#[derive(Clone, Debug)]
pub struct KernelCheck {
    /// The kernels that it runs and that no earlier step has checked.
    pub kernels: &'static [&'static str],
    /// Description of the difference; `None` if it is within the tolerance.
    pub off: Option<String>,
}

/// Width and height of the frame.
const SIZE: (u32, u32) = (100, 68);
/// Splats: more than a bucket in a tile, and more than a block of the sort.
const SPLATS: usize = 1500;
/// Splats whose footprints are compared, each alone.
const ALONE: usize = 40;
/// Splats that go through networks: more than one piece of them.
const FEW: usize = 500;
/// Projection options.
const OPTIONS: ProjectOptions = ProjectOptions { low_pass: 0.3, antialias: true, near: segwild_scene::NEAR };

/// Some of the kernels, compared.
pub type Stage = fn(&GpuEngine) -> Result<Vec<KernelCheck>, RasterError>;

/// All stages; kernels that others depend on come first.
pub const STAGES: [Stage; 6] =
    [check_sums, check_view, check_splats, check_networks, check_comparison, check_field];

/// Compares every kernel. Steps after one that is off may be off because of it.
pub fn check(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let mut checked = Vec::new();
    for stage in STAGES {
        checked.extend(stage(engine)?);
    }
    Ok(checked)
}

/// Compares running sums and the sort.
pub fn check_sums(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let checked = |kernels, off: Result<(), String>| KernelCheck { kernels, off: off.err() };
    Ok(vec![
        // Over three levels of blocks.
        checked(&["scan", "scan_add"], sums(engine, (1 << 20) + 7)?),
        checked(&["histogram", "scatter"], sort(engine, 70_000, u32::BITS)?),
    ])
}

/// Compares the kernels that render a view, and those of its backward pass.
pub fn check_view(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let mut checked = Vec::new();
    let mut add = |kernels, off: Result<(), String>| checked.push(KernelCheck { kernels, off: off.err() });
    let (splats, camera, pose) = scene();
    let lists = Lists::of(view_lists(engine, &splats, &camera, &pose, &OPTIONS)?);
    let cpu = CpuEngine::new();
    let right = cpu.project(&splats, &camera, &pose, &OPTIONS)?;
    let found = engine.project(&splats, &camera, &pose, &OPTIONS)?;
    let mut footprints = projected(&*found, &*right);
    for i in (0..splats.len()).step_by(splats.len() / ALONE) {
        let alone = splats.select(&[i]);
        let alone = cpu.project(&alone, &camera, &pose, &OPTIONS)?;
        let alpha = alone.blend(&Channels { count: 0, values: &[] })?.alpha;
        footprints = footprints.and_then(|()| lists.shape(i, &alpha));
    }
    add(&["project"], footprints);
    add(&["order", "emit", "ranges"], lists.tiles_are_right());
    add(&["bucket_count", "buckets"], lists.buckets_are_right());
    let mut random = Random::new(5);
    let values: Vec<f32> = (0..3 * splats.len()).map(|_| random.uniform() - 0.5).collect();
    let channels = Channels { count: 3, values: &values };
    let (a, b) = (found.blend(&channels)?, right.blend(&channels)?);
    let blended = Tolerance::BLENDED.compare("colours", &a.image.data, &b.image.data);
    add(&["blend"], blended.and_then(|()| Tolerance::BLENDED.compare("alpha", &a.alpha.data, &b.alpha.data)));
    let mut image = |channels| Image {
        data: (0..(SIZE.0 * SIZE.1) as usize * channels).map(|_| random.uniform() - 0.5).collect(),
        ..Image::zeros(SIZE.0 as usize, SIZE.1 as usize, channels)
    };
    let (grad, alpha) = (image(3), image(1));
    let sums = (found.gather(&grad)?, right.gather(&grad)?);
    // The light at each bucket, which `blend` leaves for later passes, is first compared here.
    add(&["blend", "gather", "sum_slots"], Tolerance::GRADIENTS.compare("sums", &sums.0, &sums.1));
    let grad = FrameGrad { image: &grad, alpha: Some(&alpha) };
    let g = found.backward(&channels, &a, &grad)?;
    let w = right.backward(&channels, &b, &grad)?;
    add(&["front", "backward", "unproject"], gradients(&g, &w));
    Ok(checked)
}

/// Compares the kernels of the splats' half of a training step.
pub fn check_splats(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let (mut splats, camera, pose) = scene();
    let random = &mut Random::new(6);
    splats.sh_degree = 3;
    splats.sh = (0..splats.len() * splats.sh_stride()).map(|_| 0.5 * random.uniform() - 0.25).collect();
    let mut checked = training(engine, &held(splats.clone()), &camera, &pose, &OPTIONS)?;
    checked.extend(training(engine, &held_with_embeddings(splats), &camera, &pose, &OPTIONS)?);
    Ok(checked)
}

/// Compares the kernels of the networks of the appearance model `gsw`.
pub fn check_networks(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let (splats, camera, pose) = scene();
    let few = splats.select(&(0..FEW).collect::<Vec<_>>());
    networks(engine, &few, &camera, &pose)
}

/// Compares the kernels of a photo's half of a step.
pub fn check_comparison(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let mut checked = Vec::new();
    for test_case in test_cases(SIZE) {
        checked.extend(compared(engine, &test_case)?);
    }
    Ok(checked)
}

/// Compares the kernels of the feature field.
pub fn check_field(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let (splats, camera, pose) = scene();
    field::field(engine, &*engine.project(&splats, &camera, &pose, &OPTIONS)?)
}

/// A ball of splats before a camera, some beyond its edges.
fn scene() -> (Splats, Camera, Pose) {
    let random = &mut Random::new(12);
    let mut within = |from: f32, to: f32| from + (to - from) * random.uniform();
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for _ in 0..SPLATS {
        splats.means.push([0; 3].map(|_| within(-0.7, 0.7)));
        splats.log_scales.push([0; 3].map(|_| within(-5.3, -2.5)));
        splats.rotations.push([0; 4].map(|_| within(-1.0, 1.0)));
        splats.opacities.push(within(-3.0, 4.0));
        splats.sh.extend([0.0; 3]);
    }
    let (width, height) = SIZE;
    let (w, h) = (width as f32, height as f32);
    let camera = Camera { width, height, fx: 1.1 * w, fy: 1.05 * w, cx: 0.47 * w, cy: 0.52 * h };
    (splats, camera, Pose::look_at(Vec3::new(0.3, -0.4, -1.6), Vec3::ZERO, Vec3::new(0.1, -1.0, 0.0)))
}

/// Running sums of so many numbers.
fn sums(engine: &GpuEngine, count: usize) -> Result<Result<(), String>, GpuError> {
    let mut random = Random::new(3);
    let numbers: Vec<u32> = (0..count).map(|_| random.below(4) as u32).collect();
    let before = |sum: &mut u32, n: &u32| Some(std::mem::replace(sum, *sum + *n));
    Ok(equal("running sums", &running_sums(engine, &numbers)?, numbers.iter().scan(0, before)))
}

/// So many items sorted by keys of so many bits, of which many are equal.
fn sort(engine: &GpuEngine, count: usize, bits: u32) -> Result<Result<(), String>, GpuError> {
    let mut random = Random::new(count as u64);
    let keys: Vec<u32> = (0..count).map(|_| (random.bits() as u32) >> (u32::BITS - bits) & !6).collect();
    let mut items: Vec<u32> = (0..count as u32).collect();
    let order = sorted(engine, &keys, &items, bits)?;
    items.sort_by_key(|&i| keys[i as usize]);
    Ok(equal("sorted items", &order, items.into_iter()))
}

/// Colour and alpha, pixel by pixel, as the device holds them.
fn interleaved(frame: &Frame) -> Vec<f32> {
    let planes = [frame.image.plane(0), frame.image.plane(1), frame.image.plane(2), &frame.alpha.data];
    (0..frame.alpha.data.len()).flat_map(|i| planes.map(|plane| plane[i])).collect()
}

fn equal(what: &str, got: &[u32], wanted: impl Iterator<Item = u32>) -> Result<(), String> {
    match got.iter().zip(wanted).enumerate().find(|(_, (g, w))| **g != *w) {
        Some((i, (g, w))) => Err(format!("{what}: number {i} is {g} where {w} is right")),
        None => Ok(()),
    }
}

/// Compares projections: which splats are seen, and of those seen by both how far, how large and where.
pub fn projected(got: &dyn Projected, wanted: &dyn Projected) -> Result<(), String> {
    let (a, b) = (got.radii(), wanted.radii());
    let other: Vec<usize> = (0..b.len()).filter(|&i| (a[i] > 0.0) != (b[i] > 0.0)).collect();
    if other.len() * 100 > b.len() {
        return Err(format!("culled by one engine only: {other:?}"));
    }
    let seen: Vec<usize> = (0..b.len()).filter(|&i| a[i] > 0.0 && b[i] > 0.0).collect();
    let of = |values: &[f32]| seen.iter().map(|&i| values[i]).collect::<Vec<_>>();
    Tolerance::PROJECTED.compare("radii", &of(a), &of(b))?;
    Tolerance::PROJECTED.compare("depths", &of(got.depths()), &of(wanted.depths()))?;
    // Those of splats behind the camera are meaningless, and not compared.
    let centres = |c: &[[f32; 2]]| seen.iter().flat_map(|&i| c[i]).collect::<Vec<_>>();
    Tolerance::PROJECTED.compare("centres", &centres(got.centres()), &centres(wanted.centres()))
}

/// Compares gradients, each array by its name.
pub fn gradients(got: &SplatGrads, wanted: &SplatGrads) -> Result<(), String> {
    type GradArray = fn(&SplatGrads) -> &[f32];
    let arrays: [(&str, GradArray); 7] = [
        ("means", |g| g.means.as_flattened()),
        ("log scales", |g| g.log_scales.as_flattened()),
        ("rotations", |g| g.rotations.as_flattened()),
        ("opacities", |g| &g.opacities),
        ("values", |g| &g.values),
        ("screen", |g| &g.screen),
        ("screen_abs", |g| &g.screen_abs),
    ];
    arrays.into_iter().try_for_each(|(what, of)| Tolerance::GRADIENTS.compare(what, of(got), of(wanted)))
}

/// What a view keeps on the device, read back.
struct Lists {
    /// Position, slope, a; e, log2 of the opacity, 1/a, reach.
    footprints: Vec<[f32; 8]>,
    depths: Vec<f32>,
    radii: Vec<f32>,
    /// Splat and slot.
    entries: Vec<[u32; 2]>,
    /// First entry, the one after the last, first bucket.
    tiles: Vec<[u32; 4]>,
    /// Tile, first entry, entries.
    buckets: Vec<[u32; 4]>,
}

impl Lists {
    fn of(lists: ViewLists) -> Lists {
        let ViewLists { footprints, seen, entries, tiles, buckets } = lists;
        let (depths, radii) = seen.iter().map(|s| (s[0], s[1])).unzip();
        Lists { footprints, depths, radii, entries, tiles, buckets }
    }

    /// Opacity of a splat at the centre of a pixel; 0 of a culled one.
    fn alpha(&self, splat: usize, x: usize, y: usize) -> f32 {
        if self.radii[splat] == 0.0 {
            return 0.0;
        }
        let [fx, fy, slope, a, e, lo, ..] = self.footprints[splat];
        let dy = y as f32 + 0.5 - fy;
        let u = x as f32 + 0.5 - fx - slope * dy;
        (lo - e * dy * dy - a * u * u).exp2().min(ALPHA_MAX)
    }

    /// Compares a splat with a render of it alone.
    fn shape(&self, splat: usize, alone: &Image) -> Result<(), String> {
        for (k, &wanted) in alone.data.iter().enumerate() {
            let found = self.alpha(splat, k % alone.width, k / alone.width);
            // Next to the cut-off one may be blended and the other not.
            if (found - wanted).abs() > 1e-3 && (found > 1.1 * ALPHA_MIN || wanted > 1.1 * ALPHA_MIN) {
                return Err(format!("splat {splat} covers pixel {k} by {found} where {wanted} is right"));
            }
        }
        Ok(())
    }

    /// Whether each tile has the splats that reach it, each once, nearest first.
    fn tiles_are_right(&self) -> Result<(), String> {
        let (width, height) = (SIZE.0 as usize, SIZE.1 as usize);
        let side = ViewLists::TILE;
        let columns = width.div_ceil(side);
        for (tile, &[from, to, ..]) in self.tiles.iter().enumerate() {
            let Some(entries) = self.entries.get(from as usize..to as usize) else {
                return Err(format!("tile {tile} has entries {from} to {to} of {}", self.entries.len()));
            };
            let splats: Vec<usize> = entries.iter().map(|e| e[0] as usize).collect();
            if let Some(odd) = splats.iter().find(|&&i| i >= self.depths.len()) {
                return Err(format!("tile {tile} has splat {odd} of {}", self.depths.len()));
            }
            if let Some(pair) = splats.windows(2).find(|w| self.depths[w[0]] > self.depths[w[1]]) {
                return Err(format!("tile {tile} has splat {} before the nearer {}", pair[0], pair[1]));
            }
            let (left, top) = (tile % columns * side, tile / columns * side);
            for splat in 0..self.depths.len() {
                let listed = splats.iter().filter(|&&i| i == splat).count();
                let mut pixels = (top..height.min(top + side))
                    .flat_map(|y| (left..width.min(left + side)).map(move |x| (x, y)));
                let reaches = pixels.any(|(x, y)| self.alpha(splat, x, y) > 1.01 * ALPHA_MIN);
                if listed > 1 || (reaches && listed == 0) {
                    return Err(format!("tile {tile} has splat {splat} {listed} times where once is right"));
                }
            }
        }
        Ok(())
    }

    /// Whether buckets hold each tile's entries, all of them, in order.
    fn buckets_are_right(&self) -> Result<(), String> {
        let mut wanted = Vec::new();
        for (tile, &[from, to, first, _]) in self.tiles.iter().enumerate() {
            if from < to && first as usize != wanted.len() {
                return Err(format!("tile {tile} has bucket {first} first where {} is right", wanted.len()));
            }
            // A faulty device may return anything.
            if to as usize > self.entries.len() {
                return Err(format!("tile {tile} ends at entry {to} of {}", self.entries.len()));
            }
            let entries = (from..to).step_by(ViewLists::BUCKET);
            wanted.extend(
                entries.map(|entry| [tile as u32, entry, (ViewLists::BUCKET as u32).min(to - entry), 0]),
            );
        }
        wanted.resize(self.buckets.len().max(wanted.len()), [0; 4]);
        match self.buckets.iter().zip(&wanted).position(|(found, wanted)| found != wanted) {
            Some(i) => Err(format!("bucket {i} is {:?} where {:?} is right", self.buckets[i], wanted[i])),
            None if self.buckets.len() < wanted.len() => {
                Err(format!("{} buckets are missing", wanted.len() - self.buckets.len()))
            }
            None => Ok(()),
        }
    }
}
