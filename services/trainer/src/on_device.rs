//! Training with the splats on the device: only the loss output of a photo, a few numbers, is read back.
//!
//! Density control downloads their shapes and uploads the result. All splats are downloaded when something needs all of
//! them: a higher degree of the colours, multi-view pruning, a checkpoint. Numbers are copied unchanged, so the result of a
//! run does not depend on when that happens.

use crate::TrainError;
use crate::density::{DensityStats, Reshaping};
use crate::model::options;
use crate::photometric::StepPhoto;
use crate::trainer::Trainer;
use segwild_objective::compare::LossOutput;
use segwild_objective::{
    AnyAppearance, EmbedAppearance, NetworksStep, Reshaped, TrainingSplats, TrainingStep,
};

impl Trainer {
    /// Whether the splats are on the device.
    pub(crate) fn is_on_device(&self) -> bool {
        self.resident.is_some()
    }

    /// Uploads the splats to the device, and the appearance model's networks with them, unless the strategy works on
    /// single splats at every step, or LPIPS is in the loss, which the host computes from the render, or a block is
    /// trained: the device has moments for all splats or none.
    pub(crate) fn upload(&mut self) -> Result<(), TrainError> {
        let part = self.photos_are_fixed() || self.state.params.trained() < self.state.params.splats.len();
        if self.is_on_device() || !self.may_upload || self.settings.lambda_lpips > 0.0 || part {
            return Ok(());
        }
        let Some(stats) = self.state.strategy.as_dyn().stats() else { return Ok(()) };
        let (params, appearance) = (&self.state.params, &self.state.appearance);
        let networks = || match appearance {
            AnyAppearance::Gsw(appearance) => Some(appearance.training_networks()),
            AnyAppearance::None(_) | AnyAppearance::Affine(_) | AnyAppearance::Embed(_) => None,
        };
        self.resident = self.engine.upload_training(&mut || TrainingSplats {
            networks: networks(),
            ..params.training_splats(stats.rows())
        })?;
        self.may_upload = self.is_on_device();
        Ok(())
    }

    /// Number of splats, on the host or on the device.
    pub(crate) fn splats(&self) -> usize {
        self.resident.as_ref().map_or(self.state.params.splats.len(), |resident| resident.count())
    }

    /// The shapes that density control works on.
    pub(crate) fn lend_shapes(&mut self) -> Result<Reshaping, TrainError> {
        let Some(resident) = &mut self.resident else { return Ok(self.state.params.lend()) };
        let (splats, sums) = resident.shapes()?;
        if let Some(stats) = self.state.strategy.as_dyn().stats() {
            *stats = DensityStats::of_rows(&sums);
        }
        // The optimiser on the device leaves only finite numbers.
        let sound = vec![true; splats.len()];
        Ok(Reshaping::new(splats, sound))
    }

    /// Takes the result of density control. The splats are downloaded if the device has no memory for them.
    pub(crate) fn take_shapes(&mut self, reshaped: Reshaped) -> Result<(), TrainError> {
        if let Some(resident) = &mut self.resident {
            if resident.reshape(&reshaped)? {
                return Ok(());
            }
            self.download()?;
            if let Some(stats) = self.state.strategy.as_dyn().stats() {
                *stats = DensityStats::new(reshaped.parents.len());
            }
        }
        self.state.params.reshape(reshaped);
        Ok(())
    }

    /// Downloads the splats to the host.
    pub(crate) fn download(&mut self) -> Result<(), TrainError> {
        let Some(resident) = &mut self.resident else { return Ok(()) };
        let mut trained = resident.download()?;
        if let (AnyAppearance::Gsw(appearance), Some(networks)) =
            (&mut self.state.appearance, trained.networks.take())
        {
            appearance.restore_networks(networks);
        }
        if let Some(stats) = self.state.strategy.as_dyn().stats() {
            *stats = DensityStats::of_rows(&trained.sums);
        }
        self.state.params.restore(trained);
        self.resident = None;
        Ok(())
    }

    /// One optimiser step on the device.
    pub(crate) fn step_on_device(&mut self, step_photo: &StepPhoto) -> Result<LossOutput, TrainError> {
        let &StepPhoto { view, level, .. } = step_photo;
        let step = self.state.step;
        let rates = self.rates(step);
        let (settings, schedule, posed) = (&self.settings, &self.schedule, &self.views[view]);
        let (params, _, mut side) = self.state.halves(view, false);
        let background = side.scene_background(view);
        let rules = match &mut *side.appearance {
            AnyAppearance::Gsw(appearance) => Some(appearance.advance(schedule.late_factor(step))),
            AnyAppearance::None(_) | AnyAppearance::Affine(_) | AnyAppearance::Embed(_) => None,
        };
        let light = below(side.appearance).map(|appearance| appearance.photo(view));
        let networks = match (&*side.appearance, rules) {
            (AnyAppearance::Gsw(appearance), Some(rules)) => {
                let draw = u64::from(step);
                let unet_input = appearance.unet_input(view, draw);
                Some(NetworksStep { unet_input, draw, decides: schedule.visible(step), rules })
            }
            _ => None,
        };
        let wanted = settings.robust && side.may_show_transients(step_photo);
        let step = TrainingStep {
            options: &options(settings.antialias),
            light: light.as_ref(),
            networks,
            loss_inputs: side.loss_inputs(settings, schedule, step_photo, &background),
            key: [self.id, view as u64, level as u64],
            target: &|| side.target(step_photo, posed, wanted),
            rules: &params.advance(&rates),
        };
        let resident = self.resident.as_mut().expect("the splats are on the device");
        let (output, light) = resident.step(&step)?;
        side.apply(step_photo, &output);
        let appearance = match &mut *side.appearance {
            AnyAppearance::Embed(appearance) => Some(appearance),
            AnyAppearance::Gsw(appearance) => Some(&mut appearance.below),
            AnyAppearance::None(_) | AnyAppearance::Affine(_) => None,
        };
        if let (Some(appearance), Some(light)) = (appearance, light) {
            appearance.add_gradient(view, &light);
        }
        Ok(output)
    }
}

/// The appearance `embed`, or the `embed` part of `gsw`.
fn below(appearance: &AnyAppearance) -> Option<&EmbedAppearance> {
    match appearance {
        AnyAppearance::Embed(appearance) => Some(appearance),
        AnyAppearance::Gsw(appearance) => Some(&appearance.below),
        AnyAppearance::None(_) | AnyAppearance::Affine(_) => None,
    }
}
