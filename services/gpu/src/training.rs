//! Splats in training, with their optimiser and the sums for density control. A step is submitted to the device at
//! once, and only its results are downloaded; the splats stay there.

use crate::GpuError;
use crate::bin::{Binned, Cloud, bin};
use crate::compare::{ComparisonInputs, GpuPhoto, LIGHT, LossBuffers, StepReadback, compare, sum_groups};
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::GROUP;
use crate::nets::{NetworkLighting, PIECE};
use crate::optimiser::{Groups, StepGrads};
use crate::parameters::{GpuParameters, GpuSplatEmbeddings, GpuTraining};
use crate::passes::ShapeGrads;
use crate::shaders::{OBSERVE, SELECT, SHADE, SHADE_BACKWARD, TINT, TINT_BACKWARD};
use segwild_objective::compare::LossOutput;
use segwild_objective::{
    DeviceTraining, EmbedLight, NetworksStep, Reshaped, SplatEmbeddings, TrainingSplats, TrainingStep,
};
use segwild_raster::{ProjectOptions, RasterError, check};
use segwild_scene::{Camera, Pose, Splats};
use std::sync::Arc;

/// A rendered view.
pub(crate) struct GpuRender<'a> {
    pub on: Binned,
    /// Depth, radius, centre per splat.
    seen: PooledBuffer,
    /// The splats' own colours, and those in the photo's light, where there is one.
    colours: PooledBuffer,
    lit: Option<LitSplats<'a>>,
    transmittances: PooledBuffer,
    /// Colour and alpha.
    pub image: PooledBuffer,
}

/// Splats in a photo's light.
struct LitSplats<'a> {
    photo: PooledBuffer,
    tinted: PooledBuffer,
    splat_embeddings: &'a GpuSplatEmbeddings,
    lighting: Option<NetworkLighting<'a>>,
}

impl<'a> GpuRender<'a> {
    /// The light of the networks of the appearance model `gsw`.
    pub fn lighting(&self) -> Option<&NetworkLighting<'a>> {
        self.lit.as_ref()?.lighting.as_ref()
    }
}

/// Parent of each splat, and whether its moments are reset.
struct Parents {
    rows: PooledBuffer,
    count: usize,
}

impl GpuTraining {
    fn try_step(&self, step: &TrainingStep) -> Result<(LossOutput, Option<EmbedLight>), GpuError> {
        loop {
            let work = &mut self.device.work();
            let (photo, capacity) = self.photos_on_device.take(work, step.key, step.target, self.count())?;
            let readback = match self.once(work, step, &photo, capacity) {
                // The capacity may be larger than the view needs.
                Err(error) if error.is_out_of_memory() && capacity.is_some() => {
                    self.photos_on_device.clear();
                    self.once(work, step, &photo, None)?
                }
                readback => readback?,
            };
            let (pairs, fits) = readback.pairs();
            self.photos_on_device.note(step.key, pairs, self.count());
            // Without capacity nothing was learnt. The next try has enough, now that the number of pairs is known.
            if fits {
                return Ok((readback.results(&step.loss_inputs), step.light.map(|_| readback.light())));
            }
        }
    }

    /// A step, submitted to the device at once, with capacity for so many pairs of a splat and a tile.
    fn once(
        &self,
        work: &mut DeviceWork,
        step: &TrainingStep,
        photo: &GpuPhoto,
        capacity: Option<usize>,
    ) -> Result<StepReadback, GpuError> {
        let loss_inputs = &step.loss_inputs;
        // An upload submits the work before it, so all uploads come first.
        let inputs = ComparisonInputs::upload(work, loss_inputs)?;
        let groups = self.groups(work, step.rules, step.networks.as_ref())?;
        let lighting = self.lighting(work, step.networks.as_ref(), loss_inputs.pose)?;
        let light = step.light.map(|light| (light, lighting));
        let rendered =
            self.draw(work, loss_inputs.camera, loss_inputs.pose, step.options, light, capacity)?;
        let decides = step.networks.as_ref().is_some_and(|networks| networks.decides);
        let visible = rendered.lighting().and_then(|lighting| lighting.visible(decides));
        let loss_buffers =
            compare(work, &rendered.on.view, &rendered.image, photo, &inputs, loss_inputs, visible.as_ref())?;
        let LossBuffers { grads, error, part_residuals, .. } = &loss_buffers;
        self.learn(work, &rendered, (grads, error, part_residuals.as_ref()), &groups, &inputs.results)?;
        StepReadback::read(work, &inputs.results, &rendered.on.found)
    }

    /// Uploads the inputs of a step of the networks, for a view from such a pose.
    pub fn lighting(
        &self,
        work: &mut DeviceWork,
        step: Option<&NetworksStep>,
        pose: &Pose,
    ) -> Result<Option<NetworkLighting<'_>>, GpuError> {
        let (Some(networks), Some(step)) = (&self.networks, step) else { return Ok(None) };
        NetworkLighting::upload(work, networks, step, pose.centre(), self.count(), PIECE).map(Some)
    }

    /// Renders the splats, with a photo's light if there is one, and with that of the networks.
    pub fn draw<'a>(
        &'a self,
        work: &mut DeviceWork,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
        light: Option<(&EmbedLight, Option<NetworkLighting<'a>>)>,
        capacity: Option<usize>,
    ) -> Result<GpuRender<'a>, GpuError> {
        let n = self.count();
        let shapes = &self.splats.shapes;
        let light = match light {
            Some((light, lighting)) => Some((work.upload("the photo's light", light)?, lighting)),
            None => None,
        };
        let (on, seen) = bin(work, shapes.clone(), camera, pose, options, capacity)?;
        let colours = work.take::<[f32; 4]>("the splats' colours", n)?;
        let job = [n as u32, self.sh_degree, 0, 0];
        let buffers = [&on.view, &shapes.means, &seen, &self.splats.sh, &colours];
        work.run(&SHADE, 1, job, &buffers, n.div_ceil(GROUP));
        let lit = match light {
            Some((photo, lighting)) => {
                let splat_embeddings = self.splat_embeddings.as_ref().expect("light needs embeddings");
                let tinted = work.take::<[f32; 4]>("the tinted colours", n)?;
                let buffers = [&photo, &colours, &splat_embeddings.values, &tinted];
                work.run(&TINT, 1, splat_embeddings.job(n), &buffers, n.div_ceil(GROUP));
                if let Some(lighting) = &lighting {
                    lighting.tint(work, &seen, &shapes.means, &splat_embeddings.values, &tinted)?;
                }
                Some(LitSplats { photo, tinted, splat_embeddings, lighting })
            }
            None => None,
        };
        let alpha = work.take::<f32>("alpha", on.pixels)?;
        let transmittances = on.transmittances(work)?;
        let values = lit.as_ref().map_or(&colours, |lit| &lit.tinted);
        let image = on.blend(work, 1, values, true, &alpha, &transmittances)?;
        Ok(GpuRender { on, seen, colours, lit, transmittances, image })
    }

    /// The backward pass and the optimiser's step from the gradients of colour and alpha. Also adds to the sums for
    /// density control, with the error at the centres, and writes the gradient of the light to `results`.
    pub fn learn(
        &self,
        work: &mut DeviceWork,
        rendered: &GpuRender,
        (by_image, error, part_residuals): (&PooledBuffer, &PooledBuffer, Option<&PooledBuffer>),
        groups: &Groups,
        results: &PooledBuffer,
    ) -> Result<(), GpuError> {
        let GpuRender { on, seen, colours, lit, transmittances, .. } = rendered;
        let n = self.count();
        let each = n.div_ceil(GROUP);
        let shapes = &self.splats.shapes;
        let by_colour = on.gather(work, 1, by_image, transmittances)?;
        let values = lit.as_ref().map_or(colours, |lit| &lit.tinted);
        let grads = on.backward(work, 1, values, by_image)?;
        // Where there is light, `by_colour` is of the tinted colours before, and of the splats' own after.
        let by_embedding = match lit {
            Some(LitSplats { photo, splat_embeddings, lighting, .. }) => {
                let by_embedding =
                    work.take::<f32>("the embeddings' gradients", n * splat_embeddings.width)?;
                if let Some(lighting) = lighting {
                    let known = (&shapes.means, &splat_embeddings.values);
                    lighting.backward(work, &by_colour, known, &by_embedding, part_residuals)?;
                }
                let sums = work.take::<EmbedLight>("the light's gradients", each)?;
                let buffers = [photo, colours, &splat_embeddings.values, &by_colour, &by_embedding, &sums];
                work.run(&TINT_BACKWARD, 1, splat_embeddings.job(n), &buffers, each);
                sum_groups(work, &sums, each, size_of::<EmbedLight>() / 4, results, LIGHT);
                Some(by_embedding)
            }
            None => None,
        };
        let by_sh = work.take::<f32>("the harmonics' gradients", n * self.sh_stride())?;
        let buffers = [&on.view, &shapes.means, seen, &self.splats.sh, &by_colour, &by_sh, &grads];
        work.run(&SHADE_BACKWARD, 1, [n as u32, self.sh_degree, 0, 0], &buffers, each);
        let buffers = [&on.view, seen, &grads, error, &self.sums, &on.found];
        work.run(&OBSERVE, 1, [n as u32, 0, 0, 0], &buffers, each);
        let grads = StepGrads { shapes: grads, sh: by_sh, splat_embeddings: by_embedding };
        let weights = rendered.lighting().map(|lighting| &lighting.weight_grads);
        self.adam(work, &grads, weights, seen, &on.found, groups);
        Ok(())
    }

    /// Gradients of 0.
    pub fn some_gradients(&self) -> Result<StepGrads, GpuError> {
        let mut work = self.device.work();
        let n = self.count();
        let shapes = work.take::<ShapeGrads>("the gradients", n)?;
        let sh = work.take::<f32>("the harmonics' gradients", n * self.sh_stride())?;
        work.clear(&shapes);
        work.clear(&sh);
        work.hand_in();
        Ok(StepGrads { shapes, sh, splat_embeddings: None })
    }

    /// Selects the items of the splats at `parents`, in their order, of so many numbers each. With `learnt`, items of
    /// forgotten splats become 0, and of each item only the first `known` numbers are kept.
    fn select(
        work: &mut DeviceWork,
        from: &PooledBuffer,
        width: usize,
        parents: &Parents,
        learnt: bool,
        known: usize,
    ) -> Result<PooledBuffer, GpuError> {
        let numbers = parents.count * width;
        let after = work.take::<f32>("the selected items", numbers)?;
        let job = [numbers as u32, width as u32, u32::from(learnt), known as u32];
        work.run(&SELECT, 1, job, &[&parents.rows, from, &after], numbers.div_ceil(GROUP));
        Ok(after)
    }

    fn try_reshape(&mut self, reshaped: &Reshaped) -> Result<(), GpuError> {
        let work = &mut self.device.work();
        let count = reshaped.parents.len();
        let rows: Vec<[u32; 2]> =
            reshaped.parents.iter().zip(&reshaped.forgotten).map(|(&p, &f)| [p, u32::from(f)]).collect();
        let shapes = Arc::new(Cloud::upload(work, &reshaped.shapes)?);
        let parents = Parents { rows: work.upload("the splats' parents", &rows)?, count };
        let sh_stride = self.sh_stride();
        // Of a centre and opacity, the opacity comes last.
        let opacities = if reshaped.opacities_forgotten { 3 } else { 4 };
        let mut moments = |of: &GpuParameters| -> Result<GpuParameters, GpuError> {
            let mut select = |from, width, known| Self::select(work, from, width, &parents, true, known);
            let shapes = Arc::new(Cloud {
                means: select(&of.shapes.means, 4, opacities)?,
                log_scales: select(&of.shapes.log_scales, 4, 4)?,
                rotations: select(&of.shapes.rotations, 4, 4)?,
                splats: count,
            });
            Ok(GpuParameters { shapes, sh: select(&of.sh, sh_stride, sh_stride)? })
        };
        let (first, second) = (moments(&self.first)?, moments(&self.second)?);
        let sh = Self::select(work, &self.splats.sh, sh_stride, &parents, false, sh_stride)?;
        let splat_embeddings = match &self.splat_embeddings {
            None => None,
            Some(splat_embeddings) => {
                let width = splat_embeddings.width;
                let mut select = |from, learnt| Self::select(work, from, width, &parents, learnt, width);
                Some(GpuSplatEmbeddings {
                    values: select(&splat_embeddings.values, false)?,
                    first: select(&splat_embeddings.first, true)?,
                    second: select(&splat_embeddings.second, true)?,
                    width,
                })
            }
        };
        let sums = work.take::<[f32; 4]>("the sums for density control", count)?;
        work.clear(&sums);
        work.hand_in();
        (self.splats, self.first, self.second) = (GpuParameters { shapes, sh }, first, second);
        (self.sums, self.splat_embeddings) = (sums, splat_embeddings);
        Ok(())
    }

    fn try_shapes(&mut self) -> Result<(Splats, Vec<[f32; 4]>), GpuError> {
        let work = &mut self.device.work();
        let mut splats = Splats { sh: vec![0.0; 3 * self.count()], ..Splats::default() };
        self.splats.shapes.read(work, &mut splats)?;
        Ok((splats, work.read(&self.sums, self.count())?))
    }

    fn try_download(&mut self) -> Result<TrainingSplats, GpuError> {
        let mut work = self.device.work();
        Ok(TrainingSplats {
            splats: self.splats.read(&mut work, self.sh_degree)?,
            first: self.first.read(&mut work, self.sh_degree)?,
            second: self.second.read(&mut work, self.sh_degree)?,
            sums: work.read(&self.sums, self.count())?,
            splat_embeddings: match &self.splat_embeddings {
                None => SplatEmbeddings::default(),
                Some(splat_embeddings) => {
                    let numbers = self.count() * splat_embeddings.width;
                    let mut read = |of: &PooledBuffer| work.read(of, numbers);
                    SplatEmbeddings {
                        values: read(&splat_embeddings.values)?,
                        first: read(&splat_embeddings.first)?,
                        second: read(&splat_embeddings.second)?,
                    }
                }
            },
            networks: match &self.networks {
                Some(networks) => Some(networks.read(&mut work)?),
                None => None,
            },
        })
    }
}

impl DeviceTraining for GpuTraining {
    fn step(&mut self, step: &TrainingStep) -> Result<(LossOutput, Option<EmbedLight>), RasterError> {
        check(&Splats::default(), step.loss_inputs.camera)?;
        Ok(self.try_step(step)?)
    }

    fn count(&self) -> usize {
        self.splats.shapes.splats
    }

    fn shapes(&mut self) -> Result<(Splats, Vec<[f32; 4]>), RasterError> {
        Ok(self.try_shapes()?)
    }

    fn reshape(&mut self, reshaped: &Reshaped) -> Result<bool, RasterError> {
        match self.try_reshape(reshaped) {
            Ok(()) => Ok(true),
            Err(error) if error.is_out_of_memory() => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    fn download(&mut self) -> Result<TrainingSplats, RasterError> {
        Ok(self.try_download()?)
    }
}
