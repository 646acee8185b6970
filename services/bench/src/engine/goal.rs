//! How long a training takes until the photos are shown so well.

use super::record::PROTOCOL;
use crate::page::PageError;
use crate::point::PointError;
use segwild_eval::oracle::OracleOptions;
use segwild_eval::record::Record;
use segwild_eval::trial::{ProviderKind, Trial, TrialError};
use segwild_flow::{Event, EventRecord, Events, Stopper, lock};
use segwild_pipeline::{RunError, RunOptions, Settings, Until, run};
use segwild_synthetic::{LightVariation, SyntheticOptions};
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// What is to be reached.
#[derive(Clone, Debug, PartialEq)]
pub struct Goal {
    /// PSNR of the training's photos, in dB.
    pub db: f32,
    /// Long side of the photos in pixels.
    pub size: u32,
    /// Folder for the scene and its runs, which is emptied.
    pub dir: PathBuf,
}

/// Photos of the scene: one light, no transients.
const PHOTOS: usize = 40;
/// Lines of the history whose mean is to reach the goal: a line is 20 steps, and every photo is seen once in two.
const LINES: usize = 5;

/// How the training went.
#[derive(Default)]
struct Course {
    began: Option<f64>,
    lately: VecDeque<f64>,
    splats: f64,
    best: f64,
    /// Seconds and steps until the goal.
    reached: Option<(f64, u64)>,
}

impl Course {
    fn observe(&mut self, goal: f64, record: &EventRecord) {
        match &record.event {
            Event::StageStarted { stage, .. } if stage == "geometry" => {
                self.began.get_or_insert(record.time);
            }
            _ if self.reached.is_some() => {}
            Event::Metric { name, value, .. } if name == "splats" => self.splats = *value,
            Event::Metric { name, value, step, .. } if name == "psnr_db" => {
                self.lately.push_back(*value);
                if self.lately.len() > LINES {
                    self.lately.pop_front();
                }
                let mean = self.lately.iter().sum::<f64>() / LINES as f64;
                self.best = self.best.max(mean);
                if let (true, Some(began)) = (self.lately.len() == LINES && mean >= goal, self.began) {
                    self.reached = Some((record.time - began, step.unwrap_or(0)));
                }
            }
            _ => {}
        }
    }
}

/// Trains a synthetic scene until the goal or the end, by an engine and, if it is an accelerator, the one of this name.
pub(super) fn train(goal: &Goal, engine: &str, adapter: &str) -> Result<Record, PageError> {
    let failed = |error: TrialError| PageError::from(PointError::from(error));
    let scene = SyntheticOptions {
        train: PHOTOS,
        test: 0,
        long_side: goal.size,
        occlusion: 0.0,
        photo_light: LightVariation::None,
        ..SyntheticOptions::default()
    };
    empty(&goal.dir)?;
    let trial =
        Trial::new(&goal.dir, &scene, ProviderKind::Builtin, &OracleOptions::default()).map_err(failed)?;
    let settings = [
        ("engine", engine.to_owned()),
        ("adapter", adapter.to_owned()),
        ("size", goal.size.to_string()),
        ("appearance_model", "none".into()),
        ("robust", "false".into()),
    ];
    let settings = Settings::layered(None, &settings.map(|(name, value)| (name.to_owned(), value)))?;
    let (events, stopper) = (Events::new(), Stopper::new());
    let course = Arc::new(Mutex::new(Course::default()));
    let sink = {
        let (course, stopper, db) = (course.clone(), stopper.clone(), f64::from(goal.db));
        events.sink("goal", move |record| {
            let mut course = lock(&course);
            course.observe(db, record);
            if course.reached.is_some() {
                stopper.stop();
            }
        })
    };
    let sink = sink.map_err(|source| PageError::Io { path: goal.dir.clone(), source })?;
    let options = RunOptions { events, stopper, until: Until::stage("geometry"), ..RunOptions::default() };
    match run(trial.scene_dir(), trial.folder(), &settings, &options) {
        Ok(_) | Err(RunError::Interrupted) => {}
        Err(error) => return Err(PointError::from(error).into()),
    }
    drop(sink);
    empty(&goal.dir)?;
    let course = lock(&course);
    let mut record = Record {
        protocol: PROTOCOL.into(),
        setting: format!("training, {engine}"),
        target: target(goal),
        numbers: BTreeMap::from([("splats".into(), course.splats), ("db".into(), course.best)]),
        ..Record::default()
    };
    match course.reached {
        Some((seconds, steps)) => {
            record.numbers.insert("seconds".into(), seconds);
            record.numbers.insert("steps".into(), steps as f64);
        }
        None => record.notes.push(format!("the training ended at {:.2} dB", course.best)),
    }
    Ok(record)
}

/// What the page calls it.
pub(super) fn target(goal: &Goal) -> String {
    format!("a scene of {PHOTOS} photos of {} px, up to {} dB", goal.size, goal.db)
}

fn empty(dir: &Path) -> Result<(), PageError> {
    match std::fs::remove_dir_all(dir) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            Err(PageError::Io { path: dir.to_owned(), source })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_goal_is_reached_by_the_mean_of_a_hundred_steps() {
        let mut course = Course::default();
        let mut tell = |time: f64, event: Event| course.observe(24.0, &EventRecord { time, event });
        tell(100.0, Event::StageStarted { stage: "geometry".into(), total: None });
        let metric = |name: &str, value: f64, step: u64| Event::Metric {
            stage: Some("geometry".into()),
            name: name.into(),
            value,
            step: Some(step),
        };
        for (k, db) in [20.0, 27.0, 22.0, 24.5, 23.0, 25.5, 30.0].into_iter().enumerate() {
            tell(101.0 + k as f64, metric("psnr_db", db, 20 * (k as u64 + 1)));
            tell(101.0 + k as f64, metric("splats", 500.0 + k as f64, 0));
        }
        // (20 + 27 + 22 + 24.5 + 23) / 5 is 23.3; without the 20 and with 25.5 it is 24.4.
        assert_eq!((course.reached, course.splats), (Some((6.0, 120)), 504.0));
        assert!((course.best - 24.4).abs() < 1e-9, "{}", course.best);
    }
}
