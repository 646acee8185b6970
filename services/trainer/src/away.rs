//! Training while the splats are where the engine computes: what crosses is what a photo says of them, in a few numbers.
//!
//! Density control asks for their shapes, and what it makes of them goes back. They come home whenever something looks at
//! all of them: a finer degree of colours, photos asked for witness, a checkpoint. Numbers travel as they are, so a run does
//! not depend on when that is.

use crate::TrainError;
use crate::density::{Reshaping, Stats};
use crate::judge::Looked;
use crate::model::options;
use crate::trainer::Trainer;
use segwild_raster::compare::Said;
use segwild_raster::{AnyLook, EmbedLook, Held, NetworksStep, Reshaped, Step};

impl Trainer {
    /// Whether the splats are where the engine computes.
    pub(crate) fn is_away(&self) -> bool {
        self.away.is_some()
    }

    /// Sends the splats to where the engine computes, and the look's networks with them, unless the strategy deals with
    /// single splats at every step.
    pub(crate) fn leave(&mut self) -> Result<(), TrainError> {
        if self.is_away() || !self.may_leave {
            return Ok(());
        }
        let Some(stats) = self.state.strategy.as_dyn().stats() else { return Ok(()) };
        let (params, look) = (&self.state.params, &self.state.look);
        let networks = || match look {
            AnyLook::Gsw(look) => Some(look.held()),
            AnyLook::None(_) | AnyLook::Affine(_) | AnyLook::Embed(_) => None,
        };
        self.away = self.engine.settle(&mut || Held { networks: networks(), ..params.held(stats.rows()) })?;
        self.may_leave = self.is_away();
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
            self.come_home()?;
            if let Some(stats) = self.state.strategy.as_dyn().stats() {
                *stats = Stats::new(reshaped.parents.len());
            }
        }
        self.state.params.reshape(reshaped);
        Ok(())
    }

    /// Has the splats here again.
    pub(crate) fn come_home(&mut self) -> Result<(), TrainError> {
        let Some(away) = &mut self.away else { return Ok(()) };
        let mut held = away.fetch()?;
        if let (AnyLook::Gsw(look), Some(networks)) = (&mut self.state.look, held.networks.take()) {
            look.take_back(networks);
        }
        if let Some(stats) = self.state.strategy.as_dyn().stats() {
            *stats = Stats::of_rows(&held.sums);
        }
        self.state.params.take_back(held);
        self.away = None;
        Ok(())
    }

    /// The step where the splats are.
    pub(crate) fn learn_away(&mut self, looked: &Looked) -> Result<Said, TrainError> {
        let &Looked { view, level, .. } = looked;
        let step = self.state.step;
        let rates = self.rates(step);
        let (settings, schedule, posed) = (&self.settings, &self.schedule, &self.views[view]);
        let (params, _, mut side) = self.state.halves(view);
        let behind = side.behind(view);
        let rules = match &mut *side.look {
            AnyLook::Gsw(look) => Some(look.advance(schedule.late_factor(step))),
            AnyLook::None(_) | AnyLook::Affine(_) | AnyLook::Embed(_) => None,
        };
        let light = below(side.look).map(|look| look.photo(view));
        let networks = match (&*side.look, rules) {
            (AnyLook::Gsw(look), Some(rules)) => {
                let draw = u64::from(step);
                let glimpse = look.glimpse(view, draw);
                Some(NetworksStep { glimpse, draw, decides: schedule.visible(step), rules })
            }
            _ => None,
        };
        let wanted = settings.robust && !looked.stored.strangers_known;
        let step = Step {
            options: &options(settings.antialias),
            light: light.as_ref(),
            networks,
            sitting: side.sitting(settings, schedule, looked, &behind),
            key: [self.id, view as u64, level as u64],
            target: &|| side.target(looked, posed, wanted),
            rules: &params.advance(&rates),
        };
        let away = self.away.as_mut().expect("the splats are away");
        let (said, light) = away.step(&step)?;
        side.hear(looked, &said);
        let look = match &mut *side.look {
            AnyLook::Embed(look) => Some(look),
            AnyLook::Gsw(look) => Some(&mut look.below),
            AnyLook::None(_) | AnyLook::Affine(_) => None,
        };
        if let (Some(look), Some(light)) = (look, light) {
            look.add_gradient(view, &light);
        }
        Ok(said)
    }
}

/// The look `embed`, or that which lies below networks.
fn below(look: &AnyLook) -> Option<&EmbedLook> {
    match look {
        AnyLook::Embed(look) => Some(look),
        AnyLook::Gsw(look) => Some(&look.below),
        AnyLook::None(_) | AnyLook::Affine(_) => None,
    }
}
