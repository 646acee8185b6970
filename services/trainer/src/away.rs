//! Training while the splats are where the engine computes: what crosses is an image and its gradient.
//!
//! They come home whenever something looks at them: density control, a finer degree of colours, photos asked for witness,
//! a checkpoint. Numbers travel as they are, so a run does not depend on when that is.

use crate::TrainError;
use crate::judge::{Judged, Looked};
use crate::model::options;
use crate::trainer::Trainer;
use segwild_raster::AnyLook;

impl Trainer {
    /// Whether the splats are where the engine computes.
    pub(crate) fn is_away(&self) -> bool {
        self.away.is_some()
    }

    /// Sends the splats to where the engine computes, unless the look's network or the
    /// strategy deals with single splats at every step.
    pub(crate) fn leave(&mut self) -> Result<(), TrainError> {
        if self.is_away() || !self.may_leave || matches!(self.state.look, AnyLook::Gsw(_)) {
            return Ok(());
        }
        let Some(stats) = self.state.strategy.as_dyn().stats() else { return Ok(()) };
        let params = &self.state.params;
        self.away = self.engine.settle(&mut || params.held(stats.rows()))?;
        self.may_leave = self.is_away();
        Ok(())
    }

    /// Has the splats here again.
    pub(crate) fn come_home(&mut self) -> Result<(), TrainError> {
        let Some(away) = &mut self.away else { return Ok(()) };
        let held = away.fetch()?;
        if let Some(stats) = self.state.strategy.as_dyn().stats() {
            *stats = crate::density::Stats::of_rows(&held.sums);
        }
        self.state.params.take_back(held);
        self.away = None;
        Ok(())
    }

    /// The splats' half of a step, where they are.
    pub(crate) fn learn_away(&mut self, looked: &Looked) -> Result<Judged, TrainError> {
        let &Looked { view, ref camera, ref pose, .. } = looked;
        let away = self.away.as_mut().expect("the splats are away");
        let light = match &self.state.look {
            AnyLook::Embed(look) => Some(look.photo(view)),
            _ => None,
        };
        let frame = away.draw(camera, pose, &options(self.settings.antialias), light.as_ref())?;
        let shown = self.state.painter(view).show(frame, camera, pose);
        let (_, _, mut photo) = self.state.halves(view);
        let judged = photo.judge(&self.settings, &self.schedule, &self.views[view], looked, None, &shown);
        let rates = self.rates(self.state.step);
        let rules = self.state.params.advance(&rates);
        let away = self.away.as_mut().expect("the splats are away");
        let light = away.learn(&judged.grad(), &judged.error, &rules)?;
        if let (AnyLook::Embed(look), Some(light)) = (&mut self.state.look, light) {
            look.add_gradient(view, &light);
        }
        Ok(judged)
    }
}
