//! How many steps and splats a given time buys, from what was measured of the machine (method, section 9).

use super::speed::StepSpeed;
use crate::initial_transients::{search_count, search_steps};
use crate::stereo_points::{COMPARED_PIXELS, compared_photos};
use crate::{Preset, TrainSettings};
use segwild_scene::{Scene, WallTime};
use serde::{Deserialize, Serialize};

/// The most steps that a time buys, as an effort: more overfits the photos (docs/experiments/2026-11-22-how-many-steps.md).
const MOST_EFFORT: f32 = 2.0;
/// The fewest splats: the scene's own divided by this. Without half of the steps less is lost than without half of the splats
/// (docs/experiments/2026-11-22-how-many-splats.md), so that steps are given up first.
const FEWEST_OF: usize = 2;

/// Time of the multi-view prunings, as a factor on the steps: a third of a step's photos are rendered for them at most, and a
/// render is about a third of a step.
const PRUNING: f64 = 1.1;
/// Steps that a photo of the stereo initialisation takes as long as, at the size that it is compared at: 3 s for 70 photos of
/// `liberty` at 320 px (docs/experiments/2026-11-21-cost-and-quality-of-whole-runs.md).
const STEREO_STEPS: f64 = 2.0;
/// Steps that a photo takes as long as after the training: visibility, lifting, its score or transient mask, objects. By choice:
/// in the charts of `desk`, `fox`, `dtu37` and `kitchen` (docs/results) all but the training takes 5 to 12 steps for a photo, and
/// with masks, descriptors and the trials of appearance models, which are measured here or have passed.
const AFTER_STEPS: f64 = 4.0;
/// Steps that a step of the feature field's refinement takes as long as, by the chart `oracle-synthetic`: 1.9 to 3.3 at 160 px.
const REFINE_STEPS: f64 = 2.0;
/// What a run may take longer than estimated.
const RESERVE: f64 = 1.1;

/// What the time of a run depends on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TimeModel {
    /// Of the training's steps.
    pub speed: StepSpeed,
    /// Seconds in which a photo is decoded and its sky is found.
    pub photo_s: f64,
    /// Seconds in which the descriptors and masks of a photo are made, with as many photos at once as in the run.
    pub described_s: f64,
    /// Photos that are trained on.
    pub photos: usize,
    /// Photos that are held out.
    pub held_out: usize,
    /// Photos that masks and descriptors are made of.
    pub described: usize,
    /// Share of the steps on photos of reduced size.
    pub coarse: f64,
    /// Trainings that search for initial transients.
    pub searches: usize,
    /// Photos that are compared for stereo initialisation.
    pub stereo_photos: usize,
    /// Steps of the feature field's refinement.
    pub refine_steps: u32,
}

impl TimeModel {
    /// Of a run of the scene with these settings, whose appearance model is decided. `described`: the photos that masks and
    /// descriptors are made of; `photo_s` and `described_s` as in the fields.
    pub fn new(
        speed: StepSpeed,
        scene: &Scene,
        settings: &TrainSettings,
        refine_steps: u32,
        described: usize,
        [photo_s, described_s]: [f64; 2],
    ) -> TimeModel {
        let photos = scene.views.iter().filter(|view| !view.test).count();
        TimeModel {
            speed,
            photo_s,
            described_s,
            photos,
            held_out: scene.views.len() - photos,
            described,
            coarse: f64::from(settings.coarse),
            searches: search_count(settings, photos),
            stereo_photos: compared_photos(settings, photos),
            refine_steps,
        }
    }

    /// Seconds of the training with so many steps and at most so many splats.
    pub fn training_s(&self, steps: u32, splats: usize) -> f64 {
        let StepSpeed { half_share, pixels, splats: own, .. } = self.speed;
        let mean = self.speed.step_s(splats) * (1.0 - self.coarse * (1.0 - half_share));
        // These have the scene's own splats, whatever the training has.
        let whole = self.speed.step_s(own);
        let searches = (self.searches as u64 * u64::from(search_steps(steps))) as f64 * whole * half_share;
        let compared_share = (COMPARED_PIXELS as f64 / pixels.max(1) as f64).min(1.0);
        let stereo = self.stereo_photos as f64 * STEREO_STEPS * whole * compared_share;
        f64::from(steps) * mean * PRUNING + searches + stereo
    }

    /// Seconds of all else: skies, masks, descriptors, features, scores, objects. Some of it runs beside the training; where both
    /// are computed by the same cores that saves nothing.
    pub fn stages_s(&self, splats: usize) -> f64 {
        let after = AFTER_STEPS * (self.photos + self.held_out) as f64;
        let refining = REFINE_STEPS * f64::from(self.refine_steps);
        (self.photos + self.held_out) as f64 * self.photo_s
            + self.described as f64 * self.described_s
            + (after + refining) * self.speed.step_s(splats)
    }

    /// Seconds of both, with a reserve.
    pub fn total_s(&self, steps: u32, splats: usize) -> f64 {
        RESERVE * (self.training_s(steps, splats) + self.stages_s(splats))
    }

    /// The steps and splats that `left_s` seconds buy; `None` where not even the least. More time buys no less of either.
    fn buys(&self, bounds: &TimeBounds, left_s: f64) -> Option<(u32, usize)> {
        let (least, most) = bounds.steps;
        let [fewest, own] = bounds.splats(self.speed.splats);
        if self.total_s(least, own) <= left_s {
            let fits = |steps: usize| self.total_s(steps as u32, own) <= left_s;
            return Some((largest(least as usize, most as usize, fits) as u32, own));
        }
        let fits = |splats: usize| self.total_s(least, splats) <= left_s;
        fits(fewest).then(|| (least, largest(fewest, own, fits)))
    }
}

/// The largest number from `least` to `most` that fits; `least` does, and what is larger than one that does not fit does not.
fn largest(least: usize, most: usize, fits: impl Fn(usize) -> bool) -> usize {
    let (mut low, mut high) = (least, most.max(least));
    while low < high {
        let middle = low + (high - low).div_ceil(2);
        if fits(middle) { low = middle } else { high = middle - 1 }
    }
    low
}

/// What a time may decide.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimeBounds {
    /// Fewest and most steps; the same where they are set.
    pub steps: (u32, u32),
    /// Whether the splats are left open.
    pub splats_open: bool,
}

impl TimeBounds {
    /// Of a training of the scene with these settings, whose appearance model is decided: from the steps of the preset `draft` to
    /// twice the scene's own. `steps_open`: the steps were left to the scene. `budget`: they were found by trials, and are the
    /// most.
    pub fn of(scene: &Scene, settings: &TrainSettings, steps_open: bool, budget: bool) -> TimeBounds {
        let at = |effort: f32| TrainSettings { steps: 0, effort, ..settings.clone() }.decided(scene).steps;
        let least = at(Preset::Draft.settings().effort);
        let steps = match (steps_open, budget) {
            (_, true) => (least.min(settings.steps), settings.steps),
            (true, false) => (least, at(MOST_EFFORT)),
            (false, false) => (settings.steps, settings.steps),
        };
        TimeBounds { steps, splats_open: settings.splats == 0 }
    }

    /// Fewest and most splats, from the scene's own or those that are set.
    fn splats(&self, own: usize) -> [usize; 2] {
        [if self.splats_open { own.div_ceil(FEWEST_OF) } else { own }, own]
    }
}

/// What a time bought for a run: decided once, and kept with it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TimeChoice {
    /// Optimiser steps.
    pub steps: u32,
    /// Most splats; 0 leaves them to the settings and the scene.
    pub splats: usize,
    /// What the time buys, in a sentence.
    pub why: String,
    /// The time that was given.
    pub time: WallTime,
    /// Seconds of the run that had passed before.
    pub spent_s: f64,
    /// What was measured.
    pub model: TimeModel,
}

/// A time in which no useful run is made.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "a time of {time} does not suffice: {spent} passed before, and on this machine {steps} steps and {splats} splats, the \
     least that give a useful scene, take about {seconds}; give {least} or more, or smaller photos",
    spent = in_words(*spent_s),
    seconds = in_words(*least_s)
)]
pub struct TooLittleTime {
    /// The time that was given.
    pub time: WallTime,
    /// The least that suffices.
    pub least: WallTime,
    /// Seconds that had passed before.
    spent_s: f64,
    /// Seconds of the least run.
    least_s: f64,
    steps: u32,
    splats: usize,
}

impl TimeChoice {
    /// What `time` buys of a run that has taken `spent_s` seconds so far. The same measurements give the same choice.
    ///
    /// # Errors
    /// Where it buys less than the least steps and splats.
    pub fn of(
        time: WallTime,
        spent_s: f64,
        model: TimeModel,
        bounds: &TimeBounds,
    ) -> Result<TimeChoice, TooLittleTime> {
        let left_s = |time: WallTime| f64::from(time.seconds()) - spent_s;
        let [fewest, own] = bounds.splats(model.speed.splats);
        let Some((steps, splats)) = model.buys(bounds, left_s(time)) else {
            let least_s = model.total_s(bounds.steps.0, fewest);
            let (least, steps) = (WallTime::rounded_up(spent_s + least_s), bounds.steps.0);
            return Err(TooLittleTime { time, least, spent_s, least_s, steps, splats: fewest });
        };
        let set = |set: bool| if set { " (as set)" } else { "" };
        let steps_set = bounds.steps.0 == bounds.steps.1;
        let rest = left_s(time) - model.total_s(steps, splats);
        let twice = WallTime::of(time.seconds().saturating_mul(2));
        let further = match model.buys(bounds, left_s(twice)) {
            Some((more, more_splats)) if (more, more_splats) != (steps, splats) => {
                format!("{twice} would buy {more} steps and {more_splats} splats")
            }
            _ => format!("more would gain nothing, and about {} are left over", in_words(rest)),
        };
        let why = format!(
            "{time} buy {steps} steps{} and {splats} splats{}: {} a step here, {} of training, {} of skies, masks, features \
             and scores, {} before them; {further}",
            set(steps_set),
            set(!bounds.splats_open),
            in_words(model.speed.step_s(splats)),
            in_words(model.training_s(steps, splats)),
            in_words(model.stages_s(splats)),
            in_words(spent_s),
        );
        let splats = if splats < own { splats } else { 0 };
        Ok(TimeChoice { steps, splats, why, time, spent_s, model })
    }
}

/// Seconds as a person reads them.
fn in_words(seconds: f64) -> String {
    match seconds {
        s if s < 0.0995 => format!("{:.0} ms", 1e3 * s.max(0.0)),
        s if s < 10.0 => format!("{s:.2} s"),
        s if s < 60.0 => format!("{s:.0} s"),
        s if s < 3600.0 => format!("{:.1} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A machine that takes a tenth of a second for a step with 20,000 splats, half of it for the splats.
    fn model() -> TimeModel {
        let (base_s, per_splat_s, half_share) = (0.05, 2.5e-6, 0.3);
        TimeModel {
            speed: StepSpeed { base_s, per_splat_s, half_share, pixels: 320 * 240, splats: 20_000 },
            photo_s: 0.05,
            described_s: 0.4,
            photos: 50,
            held_out: 6,
            described: 50,
            coarse: 0.3,
            searches: 2,
            stereo_photos: 50,
            refine_steps: 60,
        }
    }

    const OPEN: TimeBounds = TimeBounds { steps: (700, 2800), splats_open: true };

    fn choice(seconds: u32, bounds: &TimeBounds) -> Option<(u32, usize)> {
        let choice = TimeChoice::of(WallTime::of(seconds), 5.0, model(), bounds).ok()?;
        Some((choice.steps, if choice.splats == 0 { 20_000 } else { choice.splats }))
    }

    #[test]
    fn more_time_buys_no_less_and_nothing_lies_outside_the_bounds() {
        let mut before: Option<(u32, usize)> = None;
        let mut seen = [false; 4];
        for seconds in (0..1200).step_by(3) {
            let now = choice(seconds, &OPEN);
            assert!(now.is_some() || before.is_none(), "{seconds} s: {before:?} before");
            if let Some((steps, splats)) = now {
                let (fewer, less) = before.unwrap_or_default();
                assert!(steps >= fewer && splats >= less, "{seconds} s: {now:?} after {before:?}");
                assert!((700..=2800).contains(&steps) && (10_000..=20_000).contains(&splats), "{now:?}");
                assert!(splats == 20_000 || steps == 700, "steps are given up before splats: {now:?}");
                let all_s = 5.0 + model().total_s(steps, splats);
                assert!(all_s <= f64::from(seconds), "{now:?} take {all_s} s");
            }
            let reduced = now.is_some_and(|(_, splats)| splats < 20_000);
            let states = [now.is_none(), reduced, now.is_some(), now == Some((2800, 20_000))];
            states.iter().enumerate().for_each(|(i, state)| seen[i] |= state);
            before = now;
        }
        assert_eq!(seen, [true; 4], "too little, fewer splats, enough, as much as is of use");
    }

    #[test]
    fn the_whole_of_the_time_is_used_where_more_is_of_use() {
        let (steps, splats) = choice(240, &OPEN).expect("it suffices");
        assert!(steps > 700 && steps < 2800 && splats == 20_000, "{steps} {splats}");
        assert!(5.0 + model().total_s(steps + 1, splats) > 240.0);
    }

    #[test]
    fn a_faster_machine_buys_more_of_the_same_time() {
        let faster = |factor: f64| {
            let mut model = model();
            model.speed.base_s *= factor;
            model.speed.per_splat_s *= factor;
            TimeChoice::of(WallTime::of(200), 5.0, model, &OPEN).map_or(0, |choice| choice.steps)
        };
        let steps = [1.0, 0.8, 0.5, 0.02].map(faster);
        assert!(steps.is_sorted() && steps[0] < steps[1] && steps[3] == 2800, "{steps:?}");
    }

    #[test]
    fn what_is_set_stays_as_it_is() {
        let steps_set = TimeBounds { steps: (1500, 1500), splats_open: true };
        let splats_set = TimeBounds { steps: (700, 2800), splats_open: false };
        for seconds in (0..900).step_by(7) {
            assert!(choice(seconds, &steps_set).is_none_or(|(steps, _)| steps == 1500));
            assert!(choice(seconds, &splats_set).is_none_or(|(_, splats)| splats == 20_000));
        }
        let why = TimeChoice::of(WallTime::of(600), 5.0, model(), &steps_set).expect("it suffices").why;
        assert!(why.contains("1500 steps (as set)") && !why.contains("splats (as set)"), "{why}");
    }

    #[test]
    fn the_sentence_says_what_is_bought_and_what_twice_the_time_would_buy() {
        let choice = TimeChoice::of(WallTime::of(240), 5.0, model(), &OPEN).expect("it suffices");
        let twice = "8m would buy 2800 steps";
        for word in ["4m buy", "20000 splats", "0.10 s a step", "of training", "5.00 s before", twice] {
            assert!(choice.why.contains(word), "{word}: {}", choice.why);
        }
        let all = TimeChoice::of(WallTime::of(3600), 5.0, model(), &OPEN).expect("it suffices");
        assert!(all.why.contains("gain nothing") && all.why.contains("min are left over"), "{}", all.why);
        assert_eq!(all, TimeChoice::of(WallTime::of(3600), 5.0, model(), &OPEN).expect("the same"));
    }

    #[test]
    fn too_little_time_is_refused_with_the_least_that_suffices() {
        let refused = TimeChoice::of(WallTime::of(20), 5.0, model(), &OPEN).expect_err("too little");
        let words = refused.to_string();
        for word in ["20s does not suffice", "700 steps and 10000 splats"] {
            assert!(words.contains(word), "{words}");
        }
        let least = TimeChoice::of(refused.least, 5.0, model(), &OPEN).expect("what it names suffices");
        assert_eq!(least.steps, 700);
        let shorter = WallTime::of(refused.least.seconds() - 61);
        assert!(TimeChoice::of(shorter, 5.0, model(), &OPEN).is_err(), "it is the least");
    }

    #[test]
    fn the_bounds_go_from_the_steps_of_draft_to_twice_the_scenes_own() {
        use glam::Vec3;
        use segwild_scene::{Camera, Photo, Pose, View};
        let view = |i: usize| View {
            name: format!("{i}.jpg"),
            camera: Camera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 },
            pose: Pose::look_at(Vec3::X * i as f32, Vec3::X * i as f32 + Vec3::Z, Vec3::NEG_Y),
            photo: Photo::new("none"),
            test: false,
        };
        let scene = Scene::new((0..25).map(view).collect(), vec![]);
        let appearance_model = crate::AppearanceModel::Affine;
        let settings = TrainSettings { appearance_model, ..TrainSettings::default() };
        let decided = settings.decided(&scene);
        let bounds = |open, budget| TimeBounds::of(&scene, &decided, open, budget).steps;
        assert_eq!(bounds(true, false), (500, 2000));
        assert_eq!(bounds(false, false), (1000, 1000));
        assert_eq!(bounds(true, true), (500, 1000), "what trials found is the most");
        let draft = TrainSettings { effort: 0.5, ..settings.clone() }.decided(&scene);
        assert_eq!(TimeBounds::of(&scene, &draft, true, false).steps, (500, 2000), "whatever the preset");
        let few = TrainSettings { steps: 200, ..decided.clone() };
        assert_eq!(TimeBounds::of(&scene, &few, true, true).steps, (200, 200));
    }
}
