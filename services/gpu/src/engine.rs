//! The engine: projection, the two sorts, and the entries of tiles.

use crate::GpuError;
use crate::adapter::{Adapter, AdapterChoice};
use crate::compare::GpuPhotoCache;
use crate::device::{DeviceWork, GpuDevice, PooledBuffer};
use crate::field::{GpuFeatureTarget, GpuField, GpuSums};
use crate::holding::HeldEngine;
use crate::kept::GpuChannels;
use crate::memory::settles;
use crate::shaders::{
    BUCKET_COUNT, BUCKETS, EMIT, HISTOGRAM, Kernel, ORDER, PROJECT, RANGES, SCAN, SCAN_ADD, SCATTER,
};
use crate::training::GpuTraining;
use crate::view::GpuProjected;
use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use segwild_objective::field::{DeviceLifting, DeviceRefinement, FeatureTarget, Queries, Refining};
use segwild_objective::{FieldBackend, TrainingBackend};
use segwild_objective::{Held, Resident};
use segwild_raster::{
    Channels, Kept, ProjectOptions, Projected, RasterError, Rasterizer, check, jacobian_limits,
};
use segwild_scene::{Camera, Pose, Splats};
use std::any::Any;
use std::sync::Arc;

/// Width and height of a tile; as in `shaders/shared/common.wgsl`.
pub(crate) const TILE: u32 = 16;
/// Entries of a bucket.
pub(crate) const BUCKET: usize = 64;
/// Threads of a group that does one item per thread.
pub(crate) const GROUP: usize = 256;
/// Numbers that a group of the scan and of the sort holds.
const BLOCK: usize = 1024;
/// Bits of one pass of the radix sort.
const DIGIT: u32 = 4;

/// The rasteriser for accelerators. Make one and keep it: kernels are compiled on first use, and its memory is used
/// again from view to view.
pub struct GpuEngine {
    pub(crate) device: Arc<GpuDevice>,
    pub(crate) photos_on_device: Arc<GpuPhotoCache>,
}

impl GpuEngine {
    /// Opens an accelerator.
    pub fn new(choice: &AdapterChoice) -> Result<GpuEngine, GpuError> {
        GpuEngine::with_edit(choice, true, |_, text| text)
    }

    /// The same without subgroups, whether or not the accelerator has some.
    pub fn without_subgroups(choice: &AdapterChoice) -> Result<GpuEngine, GpuError> {
        GpuEngine::with_edit(choice, false, |_, text| text)
    }

    /// The same with edited kernels: tests plant faults so.
    #[doc(hidden)]
    pub fn with_edit(
        choice: &AdapterChoice,
        subgroups: bool,
        edit: impl Fn(&Kernel, String) -> String + Send + Sync + 'static,
    ) -> Result<GpuEngine, GpuError> {
        let device = Arc::new(GpuDevice::open(choice, subgroups, Box::new(edit))?);
        tracing::info!(adapter = device.adapter.name, backend = device.adapter.backend, "accelerator opened");
        Ok(GpuEngine { device, photos_on_device: Arc::default() })
    }

    /// Takes so many bytes of the accelerator's memory at the most from now on; 0 sets no limit.
    pub fn keep_within(&self, bytes: u64) {
        self.device.keep_within(bytes);
    }

    /// How many may be taken; 0 sets no limit.
    pub fn budget(&self) -> u64 {
        self.device.budget()
    }

    /// Bytes of the accelerator's memory that are taken.
    pub fn held(&self) -> u64 {
        self.device.held()
    }

    /// Bytes uploaded since it was opened, for tests.
    #[doc(hidden)]
    pub fn uploaded_bytes(&self) -> u64 {
        self.device.uploaded_bytes()
    }

    /// The accelerator in use.
    pub fn adapter(&self) -> &Adapter {
        &self.device.adapter
    }
}

/// `View` of `shaders/shared/view.wgsl`.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct ViewUniform {
    rows: [[f32; 4]; 3],
    lens: [f32; 4],
    limits: [f32; 4],
    options: [f32; 4],
    frame: [u32; 4],
}

/// The splats' shapes on the device.
pub(crate) struct Cloud {
    /// Centre, and the opacity's logit.
    pub means: PooledBuffer,
    /// Filled up with a 0.
    pub log_scales: PooledBuffer,
    pub rotations: PooledBuffer,
    pub splats: usize,
}

impl Cloud {
    pub fn upload(work: &mut DeviceWork, splats: &Splats) -> Result<Cloud, GpuError> {
        let means: Vec<[f32; 4]> =
            splats.means.par_iter().zip(&splats.opacities).map(|(&mean, &o)| with(mean, o)).collect();
        let scales: Vec<[f32; 4]> = splats.log_scales.par_iter().map(|&scale| with(scale, 0.0)).collect();
        Ok(Cloud {
            means: work.upload("the splats' centres", &means)?,
            log_scales: work.upload("the splats' scales", &scales)?,
            rotations: work.upload("the splats' rotations", &splats.rotations)?,
            splats: splats.len(),
        })
    }

    /// Downloads centres, opacities, log scales and rotations into splats that have the rest.
    pub fn read(&self, work: &mut DeviceWork, into: &mut Splats) -> Result<(), GpuError> {
        let means: Vec<[f32; 4]> = work.read(&self.means, self.splats)?;
        let scales: Vec<[f32; 4]> = work.read(&self.log_scales, self.splats)?;
        into.means = means.iter().map(|&[x, y, z, _]| [x, y, z]).collect();
        into.opacities = means.iter().map(|mean| mean[3]).collect();
        into.log_scales = scales.iter().map(|&[x, y, z, _]| [x, y, z]).collect();
        into.rotations = work.read(&self.rotations, self.splats)?;
        Ok(())
    }
}

fn with([x, y, z]: [f32; 3], w: f32) -> [f32; 4] {
    [x, y, z, w]
}

/// Buffers of a view on the device.
pub(crate) struct Binned {
    pub view: PooledBuffer,
    pub cloud: Arc<Cloud>,
    pub footprints: PooledBuffer,
    pub slots: PooledBuffer,
    pub entries: PooledBuffer,
    pub tiles: PooledBuffer,
    pub buckets: PooledBuffer,
    pub splats: usize,
    pub pixels: usize,
    pub tile_count: usize,
    /// Capacity for pairs of a splat and a tile; their exact number where it was read.
    pub pairs: usize,
    /// Number of pairs, and 1 if the capacity suffices.
    pub found: PooledBuffer,
    /// Upper bound on the buckets, known without reading from the device.
    pub bucket_bound: usize,
}

impl Rasterizer for GpuEngine {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn project<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError> {
        check(splats, camera)?;
        let cloud = Arc::new(Cloud::upload(&mut self.device.work(), splats)?);
        self.project_cloud(splats, cloud, camera, pose, options)
    }

    fn hold<'a>(&'a self, splats: &'a Splats) -> Result<Option<Box<dyn Rasterizer + 'a>>, RasterError> {
        let cloud = if_it_fits(Cloud::upload(&mut self.device.work(), splats))?.map(Arc::new);
        Ok(cloud
            .map(|cloud| Box::new(HeldEngine { engine: self, splats, cloud }) as Box<dyn Rasterizer + 'a>))
    }

    fn bring(&self, channels: &Channels) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        let uploaded_bytes = if_it_fits(GpuChannels::upload(&self.device, channels))?.flatten();
        Ok(uploaded_bytes.map(|uploaded_bytes| Box::new(uploaded_bytes) as Box<dyn Any + Send + Sync>))
    }
}

impl FieldBackend for GpuEngine {
    fn settle_refining(&self, field: &Refining) -> Result<Option<Box<dyn DeviceRefinement>>, RasterError> {
        if !settles(GpuField::bytes(field), self.budget()) {
            return Ok(None);
        }
        let field = if_it_fits(GpuField::upload(&self.device, field))?;
        Ok(field.map(|field| Box::new(field) as Box<dyn DeviceRefinement>))
    }

    fn upload_target(
        &self,
        feature_target: &FeatureTarget,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        let kept = if_it_fits(GpuFeatureTarget::keep(&self.device, feature_target))?.flatten();
        Ok(kept.map(|kept| Box::new(kept) as Box<dyn Any + Send + Sync>))
    }

    fn similarity(&self, features: &Kept, queries: &Queries) -> Result<Option<Vec<f32>>, RasterError> {
        let uploaded_bytes =
            features.on_device().and_then(|on_device| on_device.downcast_ref::<GpuChannels>());
        match uploaded_bytes.filter(|uploaded_bytes| uploaded_bytes.is_on(&self.device)) {
            Some(uploaded_bytes) => if_it_fits(uploaded_bytes.similarity(queries)),
            None => Ok(None),
        }
    }

    fn settle_lifting(
        &self,
        splats: usize,
        row: usize,
    ) -> Result<Option<Box<dyn DeviceLifting>>, RasterError> {
        if !settles(GpuSums::bytes(splats, row), self.budget()) {
            return Ok(None);
        }
        let sums = if_it_fits(GpuSums::new(&self.device, splats, row))?;
        Ok(sums.map(|sums| Box::new(sums) as Box<dyn DeviceLifting>))
    }
}

impl TrainingBackend for GpuEngine {
    fn settle(&self, held: &mut dyn FnMut() -> Held) -> Result<Option<Box<dyn Resident>>, RasterError> {
        match GpuTraining::new(&self.device, &self.photos_on_device, &held()) {
            Ok(training) => Ok(Some(Box::new(training))),
            Err(error) if error.is_out_of_memory() => {
                tracing::warn!("splats stay on the host while they are trained: {error}");
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }
}

/// A result of the device; `None` where it is out of memory.
fn if_it_fits<T>(made: Result<T, GpuError>) -> Result<Option<T>, RasterError> {
    match made {
        Ok(made) => Ok(Some(made)),
        Err(error) if error.is_out_of_memory() => Ok(None),
        Err(error) => Err(error.into()),
    }
}

impl GpuEngine {
    pub(crate) fn project_cloud<'a>(
        &'a self,
        splats: &'a Splats,
        cloud: Arc<Cloud>,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError> {
        let mut work = self.device.work();
        let (binned, seen) = bin(&mut work, cloud, camera, pose, options, None)?;
        let seen = work.read(&seen, splats.len())?;
        drop(work);
        let eye = pose.centre();
        let size = [camera.width as usize, camera.height as usize];
        Ok(Box::new(GpuProjected::new(&self.device, splats, eye, size, binned, &seen)))
    }
}

/// Projects, culls, sorts and bins. Returns the buffers of the view, and depth, radius and centre of each splat. A
/// given `capacity` for pairs of a splat and a tile is not checked here ([`Binned::found`] has the number); without it
/// the number is read from the device, which waits.
pub(crate) fn bin(
    work: &mut DeviceWork,
    cloud: Arc<Cloud>,
    camera: &Camera,
    pose: &Pose,
    options: &ProjectOptions,
    capacity: Option<usize>,
) -> Result<(Binned, PooledBuffer), GpuError> {
    let n = cloud.splats;
    let (columns, rows) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
    let tile_count = (columns * rows) as usize;
    let turn = pose.rotation.to_cols_array_2d();
    let shift = pose.translation.to_array();
    let row = |i: usize| [turn[0][i], turn[1][i], turn[2][i], shift[i]];
    let view = ViewUniform {
        rows: [row(0), row(1), row(2)],
        lens: [camera.fx, camera.fy, camera.cx, camera.cy],
        limits: jacobian_limits(camera),
        options: [options.low_pass, f32::from(u8::from(options.antialias)), options.near, 0.0],
        frame: [camera.width, camera.height, columns, rows],
    };
    let view = work.upload("the view", &[view])?;
    let Cloud { means, log_scales, rotations, .. } = &*cloud;
    let footprints = work.take::<[f32; 8]>("the splats' footprints", n)?;
    let seen = work.take::<[f32; 4]>("depths and centres", n)?;
    let counts = work.take::<u32>("counts of tiles", n)?;
    let keys = work.take::<u32>("the splats' sort keys", n)?;
    let order = work.take::<u32>("the splats' order", n)?;
    work.run(
        &PROJECT,
        1,
        [n as u32, 0, 0, 0],
        &[&view, means, log_scales, rotations, &footprints, &seen, &counts, &keys, &order],
        n.div_ceil(GROUP),
    );
    let (_, order) = sort(work, keys, order, n, u32::BITS)?;
    let starts = work.take::<u32>("the splats' first slots", n + 1)?;
    work.run(&ORDER, 1, [n as u32, 0, 0, 0], &[&order, &counts, &starts], (n + 1).div_ceil(GROUP));
    drop(counts);
    scan(work, &starts, n + 1)?;
    let pairs = match capacity {
        Some(capacity) => capacity,
        None => work.read_at::<u32>(&starts, n, 1)?[0] as usize,
    };
    let found = work.take::<u32>("how many pairs there are", 2)?;

    let slots = work.take::<[u32; 2]>("the splats' slots", n)?;
    let tile_keys = work.take::<u32>("the pairs' tiles", pairs)?;
    let tile_pairs = work.take::<u32>("the pairs' order", pairs)?;
    let owners = work.take::<u32>("the pairs' splats", pairs)?;
    work.run(
        &EMIT,
        1,
        [n as u32, tile_count as u32, pairs as u32, 0],
        &[&view, &order, &starts, &footprints, &slots, &tile_keys, &tile_pairs, &owners, &found],
        n.max(pairs).max(1).div_ceil(GROUP),
    );
    drop((order, starts));
    // One more than the tiles: pairs of no tile have the number after the last.
    let bits = u32::BITS - (tile_count as u32).leading_zeros();
    let (tile_keys, tile_pairs) = sort(work, tile_keys, tile_pairs, pairs, bits)?;
    let entries = work.take::<[u32; 2]>("the tiles' entries", pairs)?;
    let tiles = work.take::<[u32; 4]>("the tiles", tile_count)?;
    work.clear(&tiles);
    work.run(
        &RANGES,
        1,
        [pairs as u32, tile_count as u32, 0, 0],
        &[&tile_keys, &tile_pairs, &owners, &entries, &tiles],
        pairs.div_ceil(GROUP),
    );
    drop((tile_keys, tile_pairs, owners));

    let bucket_bound = if pairs == 0 { 0 } else { pairs / BUCKET + tile_count.min(pairs) };
    let buckets = work.take::<[u32; 4]>("the buckets", bucket_bound)?;
    work.clear(&buckets);
    let first = work.take::<u32>("the tiles' first buckets", tile_count)?;
    let job = [tile_count as u32, 0, 0, 0];
    work.run(&BUCKET_COUNT, 1, job, &[&tiles, &first], tile_count.div_ceil(GROUP));
    scan(work, &first, tile_count)?;
    work.run(&BUCKETS, 1, job, &[&tiles, &first, &buckets], tile_count.div_ceil(GROUP));
    work.hand_in();
    drop(first);
    let binned = Binned {
        view,
        cloud,
        footprints,
        slots,
        entries,
        tiles,
        buckets,
        splats: n,
        pixels: camera.width as usize * camera.height as usize,
        tile_count,
        pairs,
        found,
        bucket_bound,
    };
    Ok((binned, seen))
}

/// Replaces numbers by the sum of those before each.
pub(crate) fn scan(work: &mut DeviceWork, data: &PooledBuffer, count: usize) -> Result<(), GpuError> {
    let blocks = count.div_ceil(BLOCK);
    let sums = work.take::<u32>("a running sum", blocks)?;
    let job = [count as u32, 0, 0, 0];
    work.run(&SCAN, 1, job, &[data, &sums], blocks);
    if blocks > 1 {
        scan(work, &sums, blocks)?;
        work.run(&SCAN_ADD, 1, job, &[data, &sums], count.div_ceil(GROUP));
    }
    Ok(())
}

/// Stable radix sort of items by the lowest `bits` of their keys.
pub(crate) fn sort(
    work: &mut DeviceWork,
    keys: PooledBuffer,
    items: PooledBuffer,
    count: usize,
    bits: u32,
) -> Result<(PooledBuffer, PooledBuffer), GpuError> {
    if count == 0 {
        return Ok((keys, items));
    }
    let blocks = count.div_ceil(BLOCK);
    let (mut from, mut to) =
        ((keys, items), (work.take::<u32>("sort keys", count)?, work.take::<u32>("sorted items", count)?));
    let counts = work.take::<u32>("digits", blocks << DIGIT)?;
    for pass in 0..bits.div_ceil(DIGIT) {
        let job = [count as u32, pass * DIGIT, blocks as u32, 0];
        work.run(&HISTOGRAM, 1, job, &[&from.0, &counts], blocks);
        scan(work, &counts, blocks << DIGIT)?;
        work.run(&SCATTER, 1, job, &[&from.0, &from.1, &counts, &to.0, &to.1], blocks);
        std::mem::swap(&mut from, &mut to);
    }
    Ok(from)
}

#[cfg(test)]
mod tests {
    #[test]
    fn an_array_that_cannot_be_bound_is_refused_with_its_size() {
        let test = "an_array_that_cannot_be_bound_is_refused_with_its_size";
        let Some(engine) = crate::test_adapter::engine(test) else { return };
        let most = engine.adapter().binding as usize;
        let error = engine.device.work().take::<u8>("the image", most + 16).err().expect("it is too long");
        let text = error.to_string();
        assert!(text.contains("the image") && text.contains(&(most + 16).to_string()), "{text}");
        assert!(text.contains(&most.to_string()) && text.contains(&engine.adapter().name), "{text}");
    }
}
