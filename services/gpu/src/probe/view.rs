//! The passes over a view, and the lists that it keeps on the device.

use super::device_passes::DevicePasses;
use crate::bin::{BUCKET, Binned, Cloud, bin};
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::{GROUP, TILE};
use crate::passes::PIXELS;
use crate::shaders::SHADE;
use crate::sort::sort;
use crate::{GpuEngine, GpuError};
use segwild_raster::ProjectOptions;
use segwild_scene::{Camera, Pose, Splats};
use std::sync::Arc;

/// What a view keeps on the device, read back.
pub struct ViewLists {
    /// Position, slope, a; e, log2 of the opacity, 1/a, reach; per splat.
    pub footprints: Vec<[f32; 8]>,
    /// Depth, radius and centre, per splat.
    pub seen: Vec<[f32; 4]>,
    /// Splat and slot of each pair of a splat and a tile, tile by tile.
    pub entries: Vec<[u32; 2]>,
    /// First entry, the one after the last, first bucket; per tile.
    pub tiles: Vec<[u32; 4]>,
    /// Tile, first entry, entries; per bucket.
    pub buckets: Vec<[u32; 4]>,
}

impl ViewLists {
    /// Width and height of a tile in pixels.
    pub const TILE: usize = TILE as usize;
    /// Most entries of a bucket.
    pub const BUCKET: usize = BUCKET;
}

/// Projects, sorts and bins splats, and downloads the lists.
///
/// # Errors
/// When the device refuses or fails.
pub fn view_lists(
    engine: &GpuEngine,
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
    options: &ProjectOptions,
) -> Result<ViewLists, GpuError> {
    let mut work = engine.device.work();
    let cloud = Arc::new(Cloud::upload(&mut work, splats)?);
    let (on, seen) = bin(&mut work, cloud, camera, pose, options, None)?;
    Ok(ViewLists {
        footprints: work.read(&on.footprints, splats.len())?,
        seen: work.read(&seen, splats.len())?,
        entries: work.read(&on.entries, on.pairs)?,
        tiles: work.read(&on.tiles, on.tile_count)?,
        buckets: work.read(&on.buckets, on.bucket_bound)?,
    })
}

/// What the passes over a view have to do.
#[derive(Clone, Copy, Debug)]
pub struct PassCounts {
    /// Pairs of a splat and a tile.
    pub pairs: usize,
    /// Pixels of the frame.
    pub pixels: usize,
    /// Pixels of a tile.
    pub tile_pixels: usize,
    /// Buckets, at the most.
    pub buckets: usize,
}

/// The passes over a view.
pub struct ViewPasses<'e> {
    work: DeviceWork<'e>,
    camera: Camera,
    pose: Pose,
    options: ProjectOptions,
    /// vec4 of channels.
    blocks: usize,
    sh_degree: u32,
    cloud: Arc<Cloud>,
    sh: PooledBuffer,
    on: Binned,
    seen: PooledBuffer,
    keys: PooledBuffer,
    colours: PooledBuffer,
    values: PooledBuffer,
    image: PooledBuffer,
    alpha: PooledBuffer,
    transmittances: PooledBuffer,
}

impl<'e> ViewPasses<'e> {
    /// Uploads splats, of `channels` channels that are 0, and bins them.
    ///
    /// # Errors
    /// When they do not fit, or the device fails.
    pub fn upload(
        engine: &'e GpuEngine,
        splats: &Splats,
        (camera, pose): (&Camera, &Pose),
        options: &ProjectOptions,
        channels: usize,
    ) -> Result<ViewPasses<'e>, GpuError> {
        let (count, blocks) = (splats.len(), channels.div_ceil(4).max(1));
        let mut work = engine.device.work();
        let cloud = Arc::new(Cloud::upload(&mut work, splats)?);
        let sh = work.upload("the splats' harmonics", &splats.sh)?;
        let (on, seen) = bin(&mut work, cloud.clone(), camera, pose, options, None)?;
        let keys: Vec<u32> = (0..count as u32).map(|i| i.wrapping_mul(2_654_435_761)).collect();
        let keys = work.upload("keys", &keys)?;
        let colours = work.take::<[f32; 4]>("the splats' colours", count)?;
        let values = work.take::<[f32; 4]>("the splats' channels", count * blocks)?;
        let image = work.take::<[f32; 4]>("the image", on.pixels * blocks)?;
        work.clear(&values);
        work.clear(&image);
        let alpha = work.take::<f32>("alpha", on.pixels)?;
        let transmittances = on.transmittances(&mut work)?;
        let (camera, pose, options, sh_degree) = (*camera, *pose, *options, splats.sh_degree);
        Ok(ViewPasses {
            work,
            camera,
            pose,
            options,
            blocks,
            sh_degree,
            cloud,
            sh,
            on,
            seen,
            keys,
            colours,
            values,
            image,
            alpha,
            transmittances,
        })
    }

    /// What there is to do.
    pub fn counts(&self) -> PassCounts {
        let Binned { pairs, pixels, bucket_bound, .. } = self.on;
        PassCounts { pairs, pixels, tile_pixels: PIXELS, buckets: bucket_bound }
    }

    /// Projects, sorts and bins; the number of pairs is waited for.
    ///
    /// # Errors
    /// When memory does not suffice, or the device fails; so for all passes.
    pub fn project(&mut self) -> Result<(), GpuError> {
        let cloud = self.cloud.clone();
        bin(&mut self.work, cloud, &self.camera, &self.pose, &self.options, None).map(drop)
    }

    /// Sorts as many random numbers as there are splats.
    pub fn sort(&mut self) -> Result<(), GpuError> {
        let count = self.cloud.splats;
        let work = &mut self.work;
        let (from, items) = (work.take::<u32>("sort keys", count)?, work.take::<u32>("items", count)?);
        work.copy_to(&self.keys, &from, 0, 4 * count);
        sort(work, from, items, count, u32::BITS).map(drop)
    }

    /// Computes colours from harmonics.
    pub fn shade(&mut self) -> Result<(), GpuError> {
        let count = self.cloud.splats;
        let buffers = [&self.on.view, &self.cloud.means, &self.seen, &self.sh, &self.colours];
        self.work.run(&SHADE, 1, [count as u32, self.sh_degree, 0, 0], &buffers, count.div_ceil(GROUP));
        Ok(())
    }

    /// Blends the channels.
    pub fn blend(&mut self) -> Result<(), GpuError> {
        let at_once = if self.blocks == 1 { 1 } else { 4 };
        for first in (0..self.blocks).step_by(at_once) {
            let ViewPasses { work, on, values, alpha, transmittances, .. } = self;
            on.blend(work, at_once, values, first == 0, alpha, transmittances)?;
        }
        Ok(())
    }

    /// Sums an image over each splat's pixels; after [`ViewPasses::blend`].
    pub fn gather(&mut self) -> Result<(), GpuError> {
        let at_once = self.blocks.min(2);
        for _ in (0..self.blocks).step_by(at_once) {
            self.on.gather(&mut self.work, at_once, &self.image, &self.transmittances)?;
        }
        Ok(())
    }

    /// Gradients of channels and shapes; after [`ViewPasses::blend`].
    pub fn backward(&mut self) -> Result<(), GpuError> {
        self.gather()?;
        self.on.backward(&mut self.work, self.blocks, &self.values, &self.image).map(drop)
    }
}

impl DevicePasses for ViewPasses<'_> {
    fn wait(&mut self) -> Result<(), GpuError> {
        self.work.wait()
    }
}
