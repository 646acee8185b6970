//! How fast masks are made, and for how much of that time the training runs beside them.

use segwild_flow::Events;
use segwild_vision::MaskProposer;
use std::sync::Arc;
use std::time::Instant;

/// Counts while masks are made.
#[derive(Default)]
pub struct MaskSpeed {
    proposer: Option<Arc<dyn MaskProposer>>,
    /// Seconds of work on masks, summed over photos.
    seconds: f64,
    /// Those of them during which the training ran.
    beside_training: f64,
    training_ended: Option<Instant>,
}

impl MaskSpeed {
    /// Starts counting for a provider.
    pub fn of(proposer: Arc<dyn MaskProposer>) -> MaskSpeed {
        MaskSpeed { proposer: Some(proposer), ..MaskSpeed::default() }
    }

    /// Notes that the training has ended now.
    pub fn training_ended(&mut self) {
        self.training_ended = Some(Instant::now());
    }

    /// Adds one photo's masks. `seconds` is `None` if they were in the cache; `training` says whether the training
    /// still runs.
    pub fn add(&mut self, seconds: Option<f64>, training: bool) {
        let seconds = seconds.unwrap_or(0.0);
        // Seconds since the training has ended.
        let after = match self.training_ended {
            _ if training => 0.0,
            Some(end) => end.elapsed().as_secs_f64(),
            None => seconds,
        };
        self.seconds += seconds;
        self.beside_training += (seconds - after).max(0.0);
    }

    /// Reports the counts as metrics and a message, if any masks were made.
    pub fn report(&self, events: &Events) {
        if self.seconds <= 0.0 {
            return;
        }
        let metric = |name: &str, value: f64| events.metric("masks", name, value, None);
        let share = self.beside_training / self.seconds;
        metric("made_s", self.seconds);
        metric("beside_training_s", self.beside_training);
        let Some(work) = self.proposer.as_ref().and_then(|p| p.work()) else { return };
        let (Some(per_image), Some(rate)) = (work.seconds_per_image(), work.prompts_per_second()) else {
            return;
        };
        metric("encoder_s", per_image);
        metric("prompts_per_s", rate);
        events.info(
            Some("masks"),
            format!(
                "{} images encoded in {per_image:.2} s each, {} prompts answered at {rate:.0} per second; {:.0} % of \
                 the time the training went on",
                work.encoded,
                work.prompts,
                100.0 * share
            ),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_made_while_the_training_went_on_count_up_to_its_end() {
        let mut speed = MaskSpeed::default();
        speed.add(Some(3.0), true);
        speed.add(None, true);
        assert_eq!((speed.seconds, speed.beside_training), (3.0, 3.0));
        speed.training_ended();
        // Started ten seconds before it is added, and hardly after the training's end.
        speed.add(Some(10.0), false);
        assert!(speed.seconds == 13.0 && (12.0..13.0).contains(&speed.beside_training));
        // Started after it.
        let before = speed.beside_training;
        speed.add(Some(0.0), false);
        assert_eq!(speed.beside_training, before);
        // A training that was in the cache has no end in this run.
        let mut cached = MaskSpeed::default();
        cached.add(Some(2.0), false);
        assert_eq!((cached.seconds, cached.beside_training), (2.0, 0.0));
    }
}
