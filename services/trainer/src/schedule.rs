//! What changes over a run, as functions of the share of steps done.

use crate::TrainSettings;
use crate::blocks::{BlockPart, BlockTurn};

/// How far the learning rate of the centres falls.
const MEAN_DECAY: f32 = 0.01;
/// How far the other learning rates fall over the last half.
const LATE_DECAY: f32 = 0.2;

/// Multi-view prunings, at most; each in the middle of its part of this span, in
/// hundredths of the steps.
const MOST_PRUNINGS: u64 = 8;
const PRUNING_SPAN: (u64, u64) = (24, 88);
/// Shares of the steps after which photos are aligned to the splats.
const POSE_REFINEMENTS: [f32; 8] = [0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.65];
/// Photos rendered for pruning in all, per step at most: with 200 photos, eight prunings took a third as long as the steps.
const PHOTOS_PER_STEP: f64 = 1.0 / 3.0;

/// Schedules of one run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Schedule {
    /// The step of the training at which it starts.
    first: u32,
    steps: u32,
    coarse: f32,
    splat_embedding_from: f32,
    sh_degree: u32,
    /// Halvings of the photo at the end.
    finest: usize,
    /// Whether it goes on from a training that has found the transients: they are left out from its first step on.
    transients_known: bool,
}

impl Schedule {
    pub fn new(settings: &TrainSettings) -> Schedule {
        let &TrainSettings { steps, coarse, splat_embedding_from, sh_degree, .. } = settings;
        let (finest, transients_known) = (0, false);
        Schedule { first: 0, steps, coarse, splat_embedding_from, sh_degree, finest, transients_known }
    }

    /// The schedule of a turn in a training by blocks: few splats learn the whole scene from small photos, and a block
    /// goes on from there with the whole photos, and with the transients that it found.
    pub fn of_turn(settings: &TrainSettings, turn: &BlockTurn) -> Schedule {
        let whole = Schedule::new(settings);
        let &BlockTurn { part, first, steps, late } = turn;
        match part {
            _ if late => whole,
            BlockPart::Coarse => Schedule { first, steps, finest: 1, ..whole },
            BlockPart::Block(_) | BlockPart::Seams => {
                Schedule { first, steps, coarse: 0.0, transients_known: true, ..whole }
            }
        }
    }

    /// The same on photos that are halved so many times at the least.
    pub fn no_finer_than(self, finest: usize) -> Schedule {
        Schedule { finest, ..self }
    }

    /// 1 at the last step, and after it: a continued training keeps its last rates.
    fn share(&self, step: u32) -> f32 {
        (self.since_start(step) as f32 / self.steps as f32).min(1.0)
    }

    /// Steps since the schedule started.
    pub fn since_start(&self, step: u32) -> u32 {
        step.saturating_sub(self.first)
    }

    /// Halvings of the photo at a step: two for the first third of the coarse part, then one, then none.
    pub fn level(&self, step: u32) -> usize {
        let t = self.share(step);
        let level = if t < self.coarse * 0.3333 {
            2
        } else if t < self.coarse {
            1
        } else {
            0
        };
        level.max(self.finest)
    }

    /// Degree of the colours in use at a step: all of them by 60 % of the run.
    pub fn sh_degree(&self, step: u32) -> u32 {
        ((self.share(step) * (self.sh_degree as f32 + 1.0) / 0.6) as u32).min(self.sh_degree)
    }

    /// Factor on the learning rate of the centres: exponential decay (method, section 2).
    pub fn mean_factor(&self, step: u32) -> f32 {
        MEAN_DECAY.powf(self.share(step))
    }

    /// Factor on every other learning rate: constant, then falling, so that the end settles.
    pub fn late_factor(&self, step: u32) -> f32 {
        LATE_DECAY.powf((2.0 * self.share(step) - 1.0).max(0.0))
    }

    /// Factor on the learning rate of the per-splat appearance embeddings: as for the others, once shapes have settled
    /// without them.
    pub fn embedding_factor(&self, step: u32) -> f32 {
        if self.share(step) < self.splat_embedding_from { 0.0 } else { self.late_factor(step) }
    }

    /// Whether transients are left out at a step: not before the scene explains anything, and not so late that they
    /// have become part of it.
    pub fn robust(&self, step: u32) -> bool {
        self.transients_known || self.share(step) >= 0.15
    }

    /// Whether the transients of the network's visibility map are left out: after it has had time to learn them.
    pub fn visible(&self, step: u32) -> bool {
        self.transients_known || self.share(step) >= 0.3
    }

    /// Whether splats without multi-view support are pruned after so many steps: eight times, or fewer where photos
    /// are many, from the time transients are left out until enough steps are left to repair the gaps.
    pub fn multi_view_pruning(&self, step: u32, photos: usize) -> bool {
        let (step, steps) = (self.since_start(step), u64::from(self.steps));
        let times = (steps as f64 * PHOTOS_PER_STEP / photos.max(1) as f64).round() as u64;
        let times = times.min(MOST_PRUNINGS);
        let (from, until) = PRUNING_SPAN;
        let at = |k: u64| steps * (2 * times * from + (until - from) * (2 * k + 1)) / (200 * times);
        (0..times).any(|k| u64::from(step) == at(k)) && step > 0
    }

    /// Whether photos are aligned to the splats after so many steps.
    pub fn pose_refinement(&self, step: u32) -> bool {
        let at = |share: f32| (share * self.steps as f32).round() as u32;
        let step = self.since_start(step);
        step > 0 && POSE_REFINEMENTS.iter().any(|&share| at(share) == step)
    }

    /// Steps for which residuals are no evidence of transients, after an opacity reset and where photos grow finer: detail of
    /// a finer photo that the scene has yet to learn contradicts it as a transient does, and a pixel that is left out is
    /// never learnt.
    pub fn pause(&self) -> u32 {
        self.steps / 30
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splats_are_pruned_eight_times_and_less_often_where_photos_are_many() {
        let pruned_at = |steps: u32, photos: usize| -> Vec<u32> {
            let s = Schedule::new(&TrainSettings { steps, ..TrainSettings::default() });
            (0..=steps).filter(|&step| s.multi_view_pruning(step, photos)).collect()
        };
        assert_eq!(pruned_at(1000, 40), [280, 360, 440, 520, 600, 680, 760, 840]);
        assert_eq!(pruned_at(2828, 200), [859, 1221, 1583, 1945, 2307]);
        assert_eq!(
            (pruned_at(1000, 350), pruned_at(100, 100).len(), pruned_at(1, 1).len()),
            (vec![560], 0, 0)
        );
    }

    #[test]
    fn a_block_has_the_schedules_of_a_whole_run_at_its_turn() {
        let settings = TrainSettings { steps: 2000, coarse: 0.0, ..TrainSettings::default() };
        let whole = Schedule::new(&TrainSettings { steps: 500, ..settings.clone() });
        let turn = BlockTurn { part: BlockPart::Block(1), first: 900, steps: 500, late: false };
        let block = Schedule::of_turn(&settings, &turn);
        for step in 0..=500 {
            let at = 900 + step;
            assert_eq!(
                (block.level(at), block.mean_factor(at), block.late_factor(at), block.sh_degree(at)),
                (whole.level(step), whole.mean_factor(step), whole.late_factor(step), whole.sh_degree(step))
            );
            assert!(
                block.robust(at) && block.visible(at),
                "{step}: the coarse training has found the transients"
            );
            assert_eq!(block.multi_view_pruning(at, 20), whole.multi_view_pruning(step, 20), "{step}");
            assert_eq!(block.pose_refinement(at), whole.pose_refinement(step), "{step}");
        }
        let late = Schedule::of_turn(&settings, &BlockTurn { late: true, ..turn });
        assert_eq!(late.mean_factor(1900), Schedule::new(&settings).mean_factor(1900));
    }

    #[test]
    fn any_number_of_steps_is_a_whole_run() {
        for steps in [1, 7, 500, 30_000] {
            let s = Schedule::new(&TrainSettings { steps, sh_degree: 3, ..TrainSettings::default() });
            let last = steps - 1;
            assert!(
                (1..=steps).all(|k| s.level(k) <= s.level(k - 1) && s.sh_degree(k) >= s.sh_degree(k - 1))
            );
            assert_eq!((s.level(steps), s.sh_degree(steps)), (0, 3));
            assert!(s.mean_factor(last) >= MEAN_DECAY * 0.99 && s.late_factor(last) >= LATE_DECAY * 0.99);
        }
    }
}
