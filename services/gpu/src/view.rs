//! A view of splats that the host keeps: channels are uploaded, unless they are on the device already; images and
//! gradients are downloaded.

use crate::GpuError;
use crate::bin::Binned;
use crate::channels::GpuChannels;
use crate::device::{DeviceWork, GpuDevice, PooledBuffer, lock};
use crate::packing::{at_once, gathered_at_once, pack_image, pack_splats, unpack_image};
use crate::passes::ShapeGrads;
use glam::Vec3;
use rayon::prelude::*;
use segwild_raster::{
    Channels, Frame, FrameGrad, Projected, RasterError, ResidentChannels, SplatGrads, shade, shade_backward,
};
use segwild_scene::{Image, Splats};
use std::any::Any;
use std::sync::{Arc, Mutex};

/// Source of the channels that a view blends.
#[derive(Clone, Copy)]
enum ChannelSource<'a> {
    Host(&'a [f32]),
    Resident(&'a GpuChannels),
}

/// Splats as one view sees them: what the host has of it, and what the device has.
pub(crate) struct GpuProjected<'a> {
    splats: &'a Splats,
    eye: Vec3,
    depths: Vec<f32>,
    radii: Vec<f32>,
    centres: Vec<[f32; 2]>,
    view: GpuView,
}

/// A view on the device.
pub(crate) struct GpuView {
    pub device: Arc<GpuDevice>,
    splats: usize,
    width: usize,
    height: usize,
    pub on: Binned,
    /// Light per pixel at the start of each bucket, once something was blended.
    transmittances: Mutex<Option<PooledBuffer>>,
}

impl<'a> GpuProjected<'a> {
    pub fn new(
        device: &Arc<GpuDevice>,
        splats: &'a Splats,
        eye: Vec3,
        [width, height]: [usize; 2],
        on: Binned,
        seen: &[[f32; 4]],
    ) -> GpuProjected<'a> {
        let (device, transmittances) = (device.clone(), Mutex::new(None));
        GpuProjected {
            splats,
            eye,
            depths: seen.iter().map(|s| s[0]).collect(),
            radii: seen.iter().map(|s| s[1]).collect(),
            centres: seen.iter().map(|s| [s[2], s[3]]).collect(),
            view: GpuView { device, splats: splats.len(), width, height, on, transmittances },
        }
    }
}

impl GpuView {
    /// The view of one of this device's engines.
    ///
    /// # Panics
    /// If it is of another device.
    pub fn of<'v>(view: &'v dyn Projected, device: &Arc<GpuDevice>) -> &'v GpuView {
        let own = view.on_device().and_then(|view| view.downcast_ref::<GpuView>());
        own.filter(|view| view.is_on(device)).expect("the view is on the device that has the features")
    }

    /// How many splats there are.
    pub fn splats(&self) -> usize {
        self.splats
    }

    /// Width and height.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    pub fn assert_image(&self, image: &Image, channels: usize, what: &str) {
        let size = (image.width, image.height, image.channels);
        assert_eq!(size, (self.width, self.height, channels), "{what}: width, height, channels");
        assert_eq!(image.data.len(), self.pixels() * channels, "{what}: numbers");
    }

    /// Blends so many channels.
    fn try_blend(&self, count: usize, channels: ChannelSource) -> Result<Frame, GpuError> {
        let (n, pixels) = (self.splats, self.pixels());
        let mut image = Image::zeros(self.width, self.height, count);
        let mut work = self.device.work();
        let alpha = work.take::<f32>("alpha", pixels)?;
        let transmittances = self.on.transmittances(&mut work)?;
        let blocks = at_once(count);
        let mut first = 0;
        loop {
            let up;
            let values = match channels {
                // Blended, but not read.
                _ if count == 0 => {
                    up = work.take::<[f32; 4]>("the splats' channels", n)?;
                    &up
                }
                ChannelSource::Resident(resident) => resident.part(first),
                ChannelSource::Host(values) => {
                    let packed = pack_splats(values, n, count, first, blocks, false);
                    up = work.upload("the splats' channels", &packed)?;
                    &up
                }
            };
            let rendered = self.on.blend(&mut work, blocks, values, first == 0, &alpha, &transmittances)?;
            if count > 0 {
                let rendered: Vec<f32> = work.read(&rendered, pixels * blocks * 4)?;
                unpack_image(&rendered, blocks * 4, first, &mut image);
            }
            first += blocks * 4;
            if first >= count {
                break;
            }
        }
        let alpha = Image { data: work.read(&alpha, pixels)?, ..Image::zeros(self.width, self.height, 1) };
        drop(work);
        *lock(&self.transmittances) = Some(transmittances);
        Ok(Frame { image, alpha })
    }

    /// Runs with the transmittance at the buckets, from the last blend or from a blend of no channels.
    pub fn with_transmittances<T>(
        &self,
        work: &mut DeviceWork,
        run: impl FnOnce(&mut DeviceWork, &PooledBuffer) -> Result<T, GpuError>,
    ) -> Result<T, GpuError> {
        let mut stored = lock(&self.transmittances);
        if stored.is_none() {
            let values = work.take::<[f32; 4]>("the splats' channels", self.splats)?;
            let alpha = work.take::<f32>("alpha", self.pixels())?;
            let transmittances = self.on.transmittances(work)?;
            self.on.blend(work, 1, &values, true, &alpha, &transmittances)?;
            *stored = Some(transmittances);
        }
        run(work, stored.as_ref().expect("it was made above"))
    }

    /// Whether this is the view's device. A device in use has a unique address.
    pub fn is_on(&self, device: &Arc<GpuDevice>) -> bool {
        Arc::ptr_eq(device, &self.device)
    }

    /// Sums of an image per splat, in parts of so many vec4, kept on the device.
    pub fn gathered(
        &self,
        work: &mut DeviceWork,
        image: &Image,
    ) -> Result<(Vec<PooledBuffer>, usize), GpuError> {
        let blocks = gathered_at_once(image.channels);
        let parts = self.with_transmittances(work, |work, transmittances| {
            let mut parts = Vec::new();
            for first in (0..image.channels).step_by(blocks * 4) {
                let up = work.upload("the image", &pack_image(image, first, blocks, None))?;
                parts.push(self.on.gather(work, blocks, &up, transmittances)?);
            }
            Ok(parts)
        })?;
        Ok((parts, blocks))
    }

    fn try_gather(&self, work: &mut DeviceWork, image: &Image) -> Result<Vec<f32>, GpuError> {
        let (n, count, on) = (self.splats, image.channels, &self.on);
        let mut out = vec![0.0; n * count];
        if out.is_empty() || on.pairs == 0 {
            return Ok(out);
        }
        let blocks = gathered_at_once(count);
        self.with_transmittances(work, |work, transmittances| {
            for first in (0..count).step_by(blocks * 4) {
                let up = work.upload("the image", &pack_image(image, first, blocks, None))?;
                let sums = on.gather(work, blocks, &up, transmittances)?;
                let sums: Vec<f32> = work.read(&sums, n * blocks * 4)?;
                let many = (count - first).min(blocks * 4);
                out.par_chunks_mut(count).zip(sums.par_chunks(blocks * 4)).for_each(|(out, sums)| {
                    out[first..first + many].copy_from_slice(&sums[..many]);
                });
            }
            Ok(())
        })?;
        Ok(out)
    }

    fn try_backward(&self, channels: &Channels, grad: &FrameGrad) -> Result<SplatGrads, GpuError> {
        let Channels { count, values } = *channels;
        let (n, on) = (self.splats, &self.on);
        let mut work = self.device.work();
        let work = &mut work;
        let by_value = self.try_gather(work, grad.image)?;
        let grads = if on.pairs == 0 {
            vec![ShapeGrads::default(); n]
        } else {
            self.try_geometry(work, count, values, grad)?
        };
        Ok(SplatGrads {
            means: grads.iter().map(|g| [g[0][0], g[0][1], g[0][2]]).collect(),
            opacities: grads.iter().map(|g| g[0][3]).collect(),
            log_scales: grads.iter().map(|g| [g[1][0], g[1][1], g[1][2]]).collect(),
            screen: grads.iter().map(|g| g[1][3]).collect(),
            rotations: grads.iter().map(|g| g[2]).collect(),
            screen_abs: grads.iter().map(|g| g[3][0]).collect(),
            values: by_value,
        })
    }

    fn try_geometry(
        &self,
        work: &mut DeviceWork,
        count: usize,
        values: &[f32],
        grad: &FrameGrad,
    ) -> Result<Vec<ShapeGrads>, GpuError> {
        let (n, on) = (self.splats, &self.on);
        // Alpha is one more channel, of value 1.
        let blocks = (count + usize::from(grad.alpha.is_some())).max(1).div_ceil(4);
        let packed = pack_splats(values, n, count, 0, blocks, grad.alpha.is_some());
        let values = work.upload("the splats' channels", &packed)?;
        let grads = work.upload("the image's gradients", &pack_image(grad.image, 0, blocks, grad.alpha))?;
        let out = on.backward(work, blocks, &values, &grads)?;
        work.read(&out, n)
    }
}

impl Projected for GpuProjected<'_> {
    fn depths(&self) -> &[f32] {
        &self.depths
    }

    fn radii(&self) -> &[f32] {
        &self.radii
    }

    fn centres(&self) -> &[[f32; 2]] {
        &self.centres
    }

    fn shade(&self) -> Vec<f32> {
        shade(self.splats, self.eye, &self.radii)
    }

    fn blend(&self, channels: &Channels) -> Result<Frame, RasterError> {
        assert_eq!(channels.values.len(), self.splats.len() * channels.count, "channels: values");
        Ok(self.view.try_blend(channels.count, ChannelSource::Host(channels.values))?)
    }

    fn blend_resident(&self, channels: &ResidentChannels) -> Result<Frame, RasterError> {
        let host = channels.on_host();
        assert_eq!(host.values.len(), self.splats.len() * host.count, "channels: values");
        let resident = channels.on_device().and_then(|on_device| on_device.downcast_ref::<GpuChannels>());
        let resident = resident.filter(|resident| resident.is_on(&self.view.device));
        Ok(self.view.try_blend(
            host.count,
            resident.map_or(ChannelSource::Host(host.values), ChannelSource::Resident),
        )?)
    }

    fn on_device(&self) -> Option<&(dyn Any + Send + Sync)> {
        Some(&self.view)
    }

    fn gather(&self, image: &Image) -> Result<Vec<f32>, RasterError> {
        self.view.assert_image(image, image.channels, "gather");
        Ok(self.view.try_gather(&mut self.view.device.work(), image)?)
    }

    fn backward(
        &self,
        channels: &Channels,
        frame: &Frame,
        grad: &FrameGrad,
    ) -> Result<SplatGrads, RasterError> {
        assert_eq!(channels.values.len(), self.splats.len() * channels.count, "channels: values");
        self.view.assert_image(&frame.image, channels.count, "frame");
        self.view.assert_image(grad.image, channels.count, "gradient");
        if let Some(alpha) = grad.alpha {
            self.view.assert_image(alpha, 1, "gradient of alpha");
        }
        Ok(self.view.try_backward(channels, grad)?)
    }

    fn shade_backward(&self, colours: &[f32], grads: &mut SplatGrads) -> Vec<f32> {
        shade_backward(self.splats, self.eye, &self.radii, colours, grads)
    }
}
