//! One step of training from given gradients, and the optimiser alone.

use super::device_passes::DevicePasses;
use crate::compare::{StepReadback, results_buffer};
use crate::device::{DeviceWork, PooledBuffer};
use crate::optimiser::{Groups, StepGrads};
use crate::packing::pack_image;
use crate::parameters::GpuTraining;
use crate::{GpuEngine, GpuError};
use segwild_objective::{DeviceTraining, EmbedLight, OptimiserRules, TrainingSplats};
use segwild_raster::{FrameGrad, ProjectOptions, RasterError};
use segwild_scene::{Camera, Image, Pose};

/// What a step left.
pub struct TrainedStep {
    /// Rendered colour and alpha per pixel, before the step.
    pub rendered: Vec<f32>,
    /// Gradient of the photo's parameters, if the splats were in its light.
    pub light: Option<EmbedLight>,
    /// The state afterwards.
    pub state: TrainingSplats,
}

/// Renders splats, in a photo's light if there is one, and steps them by the gradients of colour and alpha, and by the
/// errors of the pixels.
///
/// # Errors
/// When memory does not suffice, or the device fails.
pub fn training_step(
    engine: &GpuEngine,
    state: &TrainingSplats,
    (camera, pose, options): (&Camera, &Pose, &ProjectOptions),
    light: Option<&EmbedLight>,
    (grad, error): (&FrameGrad, &Image),
    rules: &OptimiserRules,
) -> Result<TrainedStep, RasterError> {
    let mut on_device = GpuTraining::upload(&engine.device, &engine.photos_on_device, state)?;
    let mut work = engine.device.work();
    let by_image = work.upload("the image's gradients", &pack_image(grad.image, 0, 1, grad.alpha))?;
    let error = work.upload("the errors", &error.data)?;
    let (groups, results) = (on_device.groups(&mut work, rules, None)?, results_buffer(&mut work)?);
    let light = light.map(|light| (light, None));
    let lit = light.is_some();
    let rendered = on_device.draw(&mut work, camera, pose, options, light, None)?;
    on_device.learn(&mut work, &rendered, (&by_image, &error, None), &groups, &results)?;
    let readback = StepReadback::read(&mut work, &results, &rendered.on.found)?;
    let image = work.read(&rendered.image, rendered.on.pixels * 4)?;
    drop((rendered, work));
    Ok(TrainedStep { rendered: image, light: lit.then(|| readback.light()), state: on_device.download()? })
}

/// The optimiser's step of all splats, by gradients of 0.
pub struct AdamPasses<'e> {
    work: DeviceWork<'e>,
    on_device: GpuTraining,
    grads: StepGrads,
    seen: PooledBuffer,
    found: PooledBuffer,
    groups: Groups,
}

impl<'e> AdamPasses<'e> {
    /// Uploads splats with their moments.
    ///
    /// # Errors
    /// When they do not fit.
    pub fn upload(
        engine: &'e GpuEngine,
        state: &TrainingSplats,
        rules: &OptimiserRules,
    ) -> Result<AdamPasses<'e>, GpuError> {
        let on_device = GpuTraining::upload(&engine.device, &engine.photos_on_device, state)?;
        let grads = on_device.some_gradients()?;
        let mut work = engine.device.work();
        let seen = work.take::<[f32; 4]>("depths and centres", state.splats.len())?;
        let found = work.upload("how many pairs there are", &[0u32, 1])?;
        let groups = on_device.groups(&mut work, rules, None)?;
        Ok(AdamPasses { work, on_device, grads, seen, found, groups })
    }

    /// Steps them.
    ///
    /// # Errors
    /// None by itself.
    pub fn step(&mut self) -> Result<(), GpuError> {
        let AdamPasses { work, on_device, grads, seen, found, groups } = self;
        on_device.adam(work, grads, None, seen, found, groups);
        Ok(())
    }
}

impl DevicePasses for AdamPasses<'_> {
    fn wait(&mut self) -> Result<(), GpuError> {
        self.work.wait()
    }
}
