//! A view of splats on the device: projected, culled, sorted, and binned into tiles.

use crate::GpuError;
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::{DEPTH_BITS, GROUP, TILE};
use crate::shaders::{BUCKET_COUNT, BUCKETS, EMIT, PROJECT, RANGES, SORTED_TILE_COUNTS};
use crate::sort::{scan, sort};
use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use segwild_raster::{ProjectOptions, jacobian_limits};
use segwild_scene::{Camera, Pose, Splats};
use std::sync::Arc;

/// Entries of a bucket.
pub(crate) const BUCKET: usize = 64;

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
        limits: options.jacobian_limits.unwrap_or_else(|| jacobian_limits(camera)),
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
    let (_, order) = sort(work, keys, order, n, DEPTH_BITS)?;
    let starts = work.take::<u32>("the splats' first slots", n + 1)?;
    work.run(
        &SORTED_TILE_COUNTS,
        1,
        [n as u32, 0, 0, 0],
        &[&order, &counts, &starts],
        (n + 1).div_ceil(GROUP),
    );
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
