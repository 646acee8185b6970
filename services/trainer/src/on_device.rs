//! Training while the splats are where the engine computes: what crosses is what a photo says of them, in a few numbers.
//!
//! Density control asks for their shapes, and what it makes of them goes back. They come home whenever something looks at
//! all of them: a finer degree of colours, photos asked for witness, a checkpoint. Numbers travel as they are, so a run does
//! not depend on when that is.

use crate::TrainError;
use crate::density::{Reshaping, Stats};
use crate::model::options;
use crate::photometric::Looked;
use crate::trainer::Trainer;
use segwild_raster::compare::LossOutput;
use segwild_raster::{AnyAppearance, EmbedAppearance, Held, NetworksStep, Reshaped, Step};

impl Trainer {
    /// Whether the splats are where the engine computes.
    pub(crate) fn is_on_device(&self) -> bool {
        self.away.is_some()
    }

    /// Sends the splats to where the engine computes, and the look's networks with them, unless the strategy deals with
    /// single splats at every step.
    pub(crate) fn leave(&mut self) -> Result<(), TrainError> {
        if self.is_on_device() || !self.may_leave {
            return Ok(());
        }
        let Some(stats) = self.state.strategy.as_dyn().stats() else { return Ok(()) };
        let (params, appearance) = (&self.state.params, &self.state.appearance);
        let networks = || match appearance {
            AnyAppearance::Gsw(appearance) => Some(appearance.held()),
            AnyAppearance::None(_) | AnyAppearance::Affine(_) | AnyAppearance::Embed(_) => None,
        };
        self.away = self.engine.settle(&mut || Held { networks: networks(), ..params.held(stats.rows()) })?;
        self.may_leave = self.is_on_device();
        Ok(())
    }

    /// How many splats there are, wherever they are.
    pub(crate) fn splats(&self) -> usize {
        self.away.as_ref().map_or(self.state.params.splats.len(), |away| away.count())
    }

    /// What density control works on.
    pub(crate) fn lend_shapes(&mut self) -> Result<Reshaping, TrainError> {
        let Some(away) = &mut self.away else { return Ok(self.state.params.lend()) };
        let (splats, sums) = away.shapes()?;
        if let Some(stats) = self.state.strategy.as_dyn().stats() {
            *stats = Stats::of_rows(&sums);
        }
        // No step of the optimiser there leaves anything that is no number.
        let sound = vec![true; splats.len()];
        Ok(Reshaping::new(splats, sound))
    }

    /// Has the splats be as density control left them, here if there is no room for them where they are.
    pub(crate) fn take_shapes(&mut self, reshaped: Reshaped) -> Result<(), TrainError> {
        if let Some(away) = &mut self.away {
            if away.reshape(&reshaped)? {
                return Ok(());
            }
            self.download()?;
            if let Some(stats) = self.state.strategy.as_dyn().stats() {
                *stats = Stats::new(reshaped.parents.len());
            }
        }
        self.state.params.reshape(reshaped);
        Ok(())
    }

    /// Has the splats here again.
    pub(crate) fn download(&mut self) -> Result<(), TrainError> {
        let Some(away) = &mut self.away else { return Ok(()) };
        let mut held = away.fetch()?;
        if let (AnyAppearance::Gsw(appearance), Some(networks)) =
            (&mut self.state.appearance, held.networks.take())
        {
            appearance.take_back(networks);
        }
        if let Some(stats) = self.state.strategy.as_dyn().stats() {
            *stats = Stats::of_rows(&held.sums);
        }
        self.state.params.take_back(held);
        self.away = None;
        Ok(())
    }

    /// The step where the splats are.
    pub(crate) fn step_on_device(&mut self, looked: &Looked) -> Result<LossOutput, TrainError> {
        let &Looked { view, level, .. } = looked;
        let step = self.state.step;
        let rates = self.rates(step);
        let (settings, schedule, posed) = (&self.settings, &self.schedule, &self.views[view]);
        let (params, _, mut side) = self.state.halves(view);
        let behind = side.behind(view);
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
        let wanted = settings.robust && !looked.stored.transients_known;
        let step = Step {
            options: &options(settings.antialias),
            light: light.as_ref(),
            networks,
            loss_inputs: side.loss_inputs(settings, schedule, looked, &behind),
            key: [self.id, view as u64, level as u64],
            target: &|| side.target(looked, posed, wanted),
            rules: &params.advance(&rates),
        };
        let away = self.away.as_mut().expect("the splats are away");
        let (said, light) = away.step(&step)?;
        side.hear(looked, &said);
        let appearance = match &mut *side.appearance {
            AnyAppearance::Embed(appearance) => Some(appearance),
            AnyAppearance::Gsw(appearance) => Some(&mut appearance.below),
            AnyAppearance::None(_) | AnyAppearance::Affine(_) => None,
        };
        if let (Some(appearance), Some(light)) = (appearance, light) {
            appearance.add_gradient(view, &light);
        }
        Ok(said)
    }
}

/// The look `embed`, or that which lies below networks.
fn below(appearance: &AnyAppearance) -> Option<&EmbedAppearance> {
    match appearance {
        AnyAppearance::Embed(appearance) => Some(appearance),
        AnyAppearance::Gsw(appearance) => Some(&appearance.below),
        AnyAppearance::None(_) | AnyAppearance::Affine(_) => None,
    }
}
