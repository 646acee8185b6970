//! The losses of a photo.

use super::device_passes::DevicePasses;
use crate::bin::{Binned, Cloud, bin};
use crate::compare::{ComparisonInputs, GpuPhoto, LossBuffers, StepReadback, compare};
use crate::device::{DeviceWork, PooledBuffer};
use crate::nets::Visible;
use crate::packing::pack_image;
use crate::{GpuEngine, GpuError};
use segwild_objective::compare::{LossInputs, LossOutput, PhotoTarget};
use segwild_raster::{Frame, ProjectOptions};
use segwild_scene::{Image, Splats, logit};
use std::sync::Arc;

/// What the kernels left; arrays are per pixel.
pub struct ComparedOnDevice {
    /// Shown colour and mean residual.
    pub shown: Vec<f32>,
    /// Smoothed residuals.
    pub smoothed: Vec<f32>,
    /// Weights.
    pub weights: Vec<f32>,
    /// Gradients of colour and alpha.
    pub grads: Vec<f32>,
    /// Errors around pixels, for density control.
    pub error: Vec<f32>,
    /// Residuals of the parts of the photo that the visibility map's pixels cover, if there is one.
    pub part_residuals: Option<Vec<f32>>,
    /// The loss output.
    pub output: LossOutput,
}

/// The losses of a frame against a photo.
pub struct LossPasses<'e> {
    work: DeviceWork<'e>,
    on: Binned,
    image: PooledBuffer,
    photo: GpuPhoto,
    pixels: usize,
    inputs: ComparisonInputs,
    /// Visibility map before the sigmoid, and its width and height.
    map: Option<(PooledBuffer, [usize; 2])>,
}

impl<'e> LossPasses<'e> {
    /// Uploads a frame, a photo, the inputs of the losses, and a visibility map that decides, if there is one, of
    /// numbers between 0 and 1.
    ///
    /// # Errors
    /// When they do not fit.
    pub fn upload(
        engine: &'e GpuEngine,
        frame: &Frame,
        target: &PhotoTarget,
        loss_inputs: &LossInputs,
        map: Option<&Image>,
    ) -> Result<LossPasses<'e>, GpuError> {
        let mut work = engine.device.work();
        let cloud = Arc::new(Cloud::upload(&mut work, &Splats::default())?);
        let (camera, pose) = (loss_inputs.camera, loss_inputs.pose);
        let (on, _) = bin(&mut work, cloud, camera, pose, &ProjectOptions::default(), None)?;
        let image = work.upload("the image", &pack_image(&frame.image, 0, 1, Some(&frame.alpha)))?;
        let photo = GpuPhoto::upload(&mut work, target)?;
        let inputs = ComparisonInputs::upload(&mut work, loss_inputs)?;
        let map = map.map(|map| {
            let odds: Vec<f32> = map.data.iter().map(|&sure| logit(sure)).collect();
            Ok((work.upload("the visibility map", &odds)?, [map.width, map.height]))
        });
        let map = map.transpose()?;
        Ok(LossPasses { work, on, image, photo, pixels: target.pixels.len(), inputs, map })
    }

    fn loss_buffers(&mut self, loss_inputs: &LossInputs) -> Result<LossBuffers, GpuError> {
        let visible = self.map.as_ref();
        let visible = visible.map(|(maps, size)| Visible { maps, position: 0, size: *size, decides: true });
        let LossPasses { work, on, image, photo, inputs, .. } = self;
        compare(work, &on.view, image, photo, inputs, loss_inputs, visible.as_ref())
    }

    /// Computes losses and gradients; `loss_inputs` are those that were uploaded.
    ///
    /// # Errors
    /// When memory does not suffice.
    pub fn compare(&mut self, loss_inputs: &LossInputs) -> Result<(), GpuError> {
        self.loss_buffers(loss_inputs).map(drop)
    }

    /// The same, and downloads them.
    ///
    /// # Errors
    /// When memory does not suffice, or the device fails.
    pub fn results(&mut self, loss_inputs: &LossInputs) -> Result<ComparedOnDevice, GpuError> {
        let LossBuffers { shown, smoothed, weights, grads, error, part_residuals } =
            self.loss_buffers(loss_inputs)?;
        let (work, n) = (&mut self.work, self.pixels);
        let output = StepReadback::read(work, &self.inputs.results, &self.on.found)?.results(loss_inputs);
        let parts = self.map.as_ref().map_or(0, |(_, [width, height])| width * height);
        Ok(ComparedOnDevice {
            shown: work.read(&shown, 4 * n)?,
            smoothed: work.read(&smoothed, n)?,
            weights: work.read(&weights, n)?,
            grads: work.read(&grads, 4 * n)?,
            error: work.read(&error, n)?,
            part_residuals: part_residuals
                .map(|part_residuals| work.read(&part_residuals, parts))
                .transpose()?,
            output,
        })
    }
}

impl DevicePasses for LossPasses<'_> {
    fn wait(&mut self) -> Result<(), GpuError> {
        self.work.wait()
    }
}
