//! Checks the kernels of a view against the CPU engine, and the lists that it keeps on the device.

use crate::frame::{OPTIONS, SIZE, scene};
use crate::kernel_check::KernelCheck;
use crate::mismatch::{ListMismatch, Mismatch};
use crate::tolerance::Tolerance;
use segwild_gpu::GpuEngine;
use segwild_gpu::probe::{ViewLists, view_lists};
use segwild_raster::{
    ALPHA_MAX, ALPHA_MIN, Channels, CpuEngine, FrameGrad, Projected, RasterError, Rasterizer, SplatGrads,
};
use segwild_scene::{Image, Random};

/// Splats whose footprints are compared, each alone.
const ALONE: usize = 40;

/// Compares the kernels that render a view, and those of its backward pass.
pub fn check_view(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let mut checked = Vec::new();
    let mut add = |kernels, off: Result<(), Mismatch>| checked.push(KernelCheck { kernels, off: off.err() });
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
        footprints = footprints.and_then(|()| Ok(lists.shape(i, &alpha)?));
    }
    add(&["project"], footprints);
    add(&["sorted_tile_counts", "emit", "ranges"], lists.tiles_are_right().map_err(Mismatch::from));
    add(&["bucket_count", "buckets"], lists.buckets_are_right().map_err(Mismatch::from));
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
    add(&["bucket_states", "backward", "project_backward"], gradients(&g, &w));
    Ok(checked)
}

/// Compares projections: which splats are seen, and of those seen by both how far, how large and where.
pub fn projected(got: &dyn Projected, wanted: &dyn Projected) -> Result<(), Mismatch> {
    let (a, b) = (got.radii(), wanted.radii());
    let other: Vec<usize> = (0..b.len()).filter(|&i| (a[i] > 0.0) != (b[i] > 0.0)).collect();
    if other.len() * 100 > b.len() {
        return Err(Mismatch::Culled(other));
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
pub fn gradients(got: &SplatGrads, wanted: &SplatGrads) -> Result<(), Mismatch> {
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
    fn shape(&self, splat: usize, alone: &Image) -> Result<(), ListMismatch> {
        for (pixel, &wanted) in alone.data.iter().enumerate() {
            let got = self.alpha(splat, pixel % alone.width, pixel / alone.width);
            // Next to the cut-off one may be blended and the other not.
            if (got - wanted).abs() > 1e-3 && (got > 1.1 * ALPHA_MIN || wanted > 1.1 * ALPHA_MIN) {
                return Err(ListMismatch::Opacity { splat, pixel, got, wanted });
            }
        }
        Ok(())
    }

    /// Whether each tile has the splats that reach it, each once, nearest first.
    fn tiles_are_right(&self) -> Result<(), ListMismatch> {
        let (width, height) = (SIZE.0 as usize, SIZE.1 as usize);
        let side = ViewLists::TILE;
        let columns = width.div_ceil(side);
        for (tile, &[from, to, ..]) in self.tiles.iter().enumerate() {
            let Some(entries) = self.entries.get(from as usize..to as usize) else {
                return Err(ListMismatch::Entries { tile, from, to, entries: self.entries.len() });
            };
            let splats: Vec<usize> = entries.iter().map(|e| e[0] as usize).collect();
            if let Some(&splat) = splats.iter().find(|&&i| i >= self.depths.len()) {
                return Err(ListMismatch::NoSplat { tile, splat, splats: self.depths.len() });
            }
            if let Some(pair) = splats.windows(2).find(|w| self.depths[w[0]] > self.depths[w[1]]) {
                return Err(ListMismatch::Order { tile, first: pair[0], nearer: pair[1] });
            }
            let (left, top) = (tile % columns * side, tile / columns * side);
            for splat in 0..self.depths.len() {
                let times = splats.iter().filter(|&&i| i == splat).count();
                let mut pixels = (top..height.min(top + side))
                    .flat_map(|y| (left..width.min(left + side)).map(move |x| (x, y)));
                let reaches = pixels.any(|(x, y)| self.alpha(splat, x, y) > 1.01 * ALPHA_MIN);
                if times > 1 || (reaches && times == 0) {
                    return Err(ListMismatch::Times { tile, splat, times });
                }
            }
        }
        Ok(())
    }

    /// Whether buckets hold each tile's entries, all of them, in order.
    fn buckets_are_right(&self) -> Result<(), ListMismatch> {
        let mut wanted = Vec::new();
        for (tile, &[from, to, first, _]) in self.tiles.iter().enumerate() {
            if from < to && first as usize != wanted.len() {
                return Err(ListMismatch::FirstBucket { tile, first, wanted: wanted.len() });
            }
            // A faulty device may return anything.
            if to as usize > self.entries.len() {
                return Err(ListMismatch::End { tile, to, entries: self.entries.len() });
            }
            let entries = (from..to).step_by(ViewLists::BUCKET);
            wanted.extend(
                entries.map(|entry| [tile as u32, entry, (ViewLists::BUCKET as u32).min(to - entry), 0]),
            );
        }
        wanted.resize(self.buckets.len().max(wanted.len()), [0; 4]);
        match self.buckets.iter().zip(&wanted).position(|(found, wanted)| found != wanted) {
            Some(bucket) => {
                let (got, wanted) = (self.buckets[bucket], wanted[bucket]);
                Err(ListMismatch::Bucket { bucket, got, wanted })
            }
            None if self.buckets.len() < wanted.len() => {
                Err(ListMismatch::Buckets(wanted.len() - self.buckets.len()))
            }
            None => Ok(()),
        }
    }
}
