//! Measures how long a step of a training takes on this machine, by a few steps with as many splats as it would have.

use crate::colours::coloured;
use crate::photos::{Photos, Stored};
use crate::splat_budget::SplatBudget;
use crate::trainer::photo_cache;
use crate::{TrainError, TrainSettings, Trainer};
use segwild_nn::Lpips;
use segwild_objective::Engine;
use segwild_scene::{Point, Random, Scene, knn};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::time::Instant;

/// Photos that are measured on: after so many steps each has been decoded.
const PHOTOS: usize = 4;
/// Steps of a measurement, and how many of them count, at its end: colours then have their full degree, and transients are
/// left out.
const STEPS: (u32, usize) = (14, 5);

/// Seconds that a step takes on one machine, with one engine, at the size trained at.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct StepSpeed {
    /// Of a step without splats.
    pub base_s: f64,
    /// More for each splat.
    pub per_splat_s: f64,
    /// Of a step on photos of half the size, as a share of one on whole photos.
    pub half_share: f64,
    /// Pixels of a photo.
    pub pixels: usize,
    /// The splats that the scene would have by itself.
    pub splats: usize,
}

impl StepSpeed {
    /// Of a step on whole photos with so many splats.
    pub fn step_s(&self, splats: usize) -> f64 {
        self.base_s + self.per_splat_s * splats as f64
    }

    /// From steps with different numbers of splats: each the number and the seconds of a step.
    fn of(few: (usize, f64), many: (usize, f64)) -> (f64, f64) {
        let more = many.0.saturating_sub(few.0);
        if more == 0 {
            return (many.1, 0.0);
        }
        // Neither splats nor pixels take less than no time, whatever else the machine did meanwhile.
        let per_splat = ((many.1 - few.1) / more as f64).clamp(0.0, many.1 / many.0 as f64);
        (many.1 - per_splat * many.0 as f64, per_splat)
    }
}

/// Measures the steps of a training of `scene` with these settings, whose appearance model is decided. `photos` gives photos
/// at the size trained at, `lpips` the weights for a loss that has it; `stopping` ends the work.
///
/// # Errors
/// When no photo can be used, the engine refuses, or the work is stopped.
pub fn measure_steps(
    engine: &Arc<dyn Engine>,
    scene: &Scene,
    photos: &Arc<dyn Photos>,
    settings: &TrainSettings,
    lpips: Option<&Arc<Lpips>>,
    stopping: &dyn Fn() -> bool,
) -> Result<StepSpeed, TrainError> {
    let train: Vec<usize> = (0..scene.views.len()).filter(|&v| !scene.views[v].test).collect();
    let usable: Vec<usize> = train.iter().copied().filter(|&v| photos.refused(v).is_none()).collect();
    let every = usable.len().div_ceil(PHOTOS).max(1);
    let mut apart = scene.clone();
    for (view, v) in apart.views.iter_mut().enumerate() {
        v.test = usable.iter().step_by(every).all(|&measured| measured != view);
    }
    let settings = TrainSettings { coarse: 0.0, stereo: 0.0, blocks: 1, ..settings.decided(scene) };
    let mut cache = photo_cache(&apart, photos.clone(), &settings);
    let mut held: Vec<Arc<Stored>> = Vec::new();
    for &view in usable.iter().step_by(every) {
        held.extend(cache.usable(view)?);
    }
    let pixels = held.iter().map(|stored| stored.levels[0].pixels()).max().unwrap_or(0);
    let mut budget = SplatBudget::new(&settings, scene.points.len(), train.len(), pixels);
    held.iter().for_each(|stored| budget.add_photo(stored.levels[0].ground()));
    let splats = budget.splats();
    let start = coloured(&apart, &mut cache, &|_, _| stopping())?;
    let mut timed = |splats: usize, finest: usize| -> Result<(usize, f64), TrainError> {
        let settings = TrainSettings { steps: STEPS.0, splats, ..settings.clone() };
        settings.check()?;
        let more = more_points(&start, splats);
        let mut trainer = Trainer::start(engine.clone(), &start, cache.take(), settings, finest, &more)?;
        trainer.set_lpips(lpips.cloned());
        let mut seconds = Vec::new();
        while !trainer.is_done() {
            if stopping() {
                return Err(TrainError::Stopped);
            }
            let began = Instant::now();
            trainer.step()?;
            seconds.push(began.elapsed().as_secs_f64());
        }
        let counted = trainer.splats();
        cache = trainer.photos;
        Ok((counted, typical(&seconds)))
    };
    let many = timed(splats, 0)?;
    let few = timed((splats / 2).max(1), 0)?;
    let half = timed(splats, 1)?;
    let (base_s, per_splat_s) = StepSpeed::of(few, many);
    let whole_s = base_s + per_splat_s * half.0 as f64;
    let half_share = if whole_s > 0.0 { (half.1 / whole_s).clamp(0.0, 1.0) } else { 1.0 };
    Ok(StepSpeed { base_s, per_splat_s, half_share, pixels, splats })
}

/// The median of the last steps: one of them may also prune splats, or share the machine.
fn typical(seconds: &[f64]) -> f64 {
    let mut last = seconds[seconds.len().saturating_sub(STEPS.1)..].to_vec();
    last.sort_by(f64::total_cmp);
    last.get(last.len() / 2).copied().unwrap_or(0.0)
}

/// As many points beside those of the scene as so many splats start from: near them, as far as they are from each other.
fn more_points(scene: &Scene, splats: usize) -> Vec<Point> {
    let points: Vec<&Point> = scene.points.iter().filter(|p| p.position.is_finite()).collect();
    if points.is_empty() {
        return Vec::new();
    }
    let positions: Vec<[f32; 3]> = points.iter().map(|p| p.position.into()).collect();
    let distances = knn::nearest(&positions, 3).mean_distances();
    let mut random = Random::new(1);
    let missing = splats.saturating_sub(points.len());
    (0..missing)
        .map(|i| {
            let (point, distance) = (points[i % points.len()], distances[i % points.len()]);
            let shift = [(); 3].map(|()| random.uniform() - 0.5);
            let shift = glam::Vec3::from(shift) * if distance.is_finite() { distance } else { 0.0 };
            Point { position: point.position + shift, colour: point.colour, track: Vec::new() }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{AppearanceModel, TrainPhoto};
    use glam::Vec3;
    use segwild_raster::CpuEngine;
    use segwild_scene::{Camera, Image, Photo, Pose, View};
    use std::convert::Infallible;

    #[test]
    fn two_measurements_give_the_time_of_a_step_and_of_a_splat() {
        let (base, per_splat) = StepSpeed::of((1000, 0.2), (2000, 0.3));
        assert!((base - 0.1).abs() < 1e-9 && (per_splat - 1e-4).abs() < 1e-12, "{base} {per_splat}");
        // What a busy machine measures gives neither negative times nor a step for nothing.
        assert_eq!(StepSpeed::of((1000, 0.3), (2000, 0.2)), (0.2, 0.0));
        let (base, per_splat) = StepSpeed::of((1000, 0.0), (2000, 0.4));
        assert!(base.abs() < 1e-9 && (per_splat - 2e-4).abs() < 1e-12, "{base} {per_splat}");
        assert_eq!(StepSpeed::of((2000, 0.1), (2000, 0.2)), (0.2, 0.0), "one number shows no slope");
    }

    #[test]
    fn a_scene_is_measured_with_as_many_splats_as_it_would_have() {
        let camera = Camera { width: 48, height: 36, fx: 40.0, fy: 40.0, cx: 24.0, cy: 18.0 };
        let view = |i: usize| {
            let eye = Vec3::new(0.1 * i as f32 - 0.3, 0.0, -0.5);
            let pose = Pose::look_at(eye, eye + Vec3::Z, Vec3::NEG_Y);
            View { name: format!("{i}.jpg"), camera, pose, photo: Photo::new("none"), test: i == 6 }
        };
        let points = (0..300).map(|i| {
            let position = Vec3::new(0.1 * (i % 20) as f32 - 0.95, 0.1 * (i / 20) as f32 - 0.7, 1.0);
            Point { position, colour: [0.2 + 0.002 * i as f32; 3], track: vec![] }
        });
        let scene = Scene::new((0..7).map(view).collect(), points.collect());
        let photos: Arc<dyn Photos> = Arc::new(|view: usize| {
            let image = Image::filled(48, 36, 3, 0.3 + 0.05 * view as f32);
            Ok::<_, Infallible>(TrainPhoto { image, valid: None, sky: None, transients: None })
        });
        let engine: Arc<dyn Engine> = Arc::new(CpuEngine::new());
        let appearance_model = AppearanceModel::Affine;
        let settings = TrainSettings { appearance_model, ..TrainSettings::default() };
        let measured = |settings: &TrainSettings, stop: bool| {
            measure_steps(&engine, &scene, &photos, settings, None, &|| stop)
        };
        let speed = measured(&settings, false).expect("it is measured");
        assert_eq!((speed.splats, speed.pixels), (2000, 48 * 36));
        assert!(speed.step_s(2000) > 0.0 && speed.base_s >= 0.0 && speed.per_splat_s >= 0.0, "{speed:?}");
        assert!((0.0..=1.0).contains(&speed.half_share), "{speed:?}");
        let set = TrainSettings { splats: 700, ..settings.clone() };
        assert_eq!(measured(&set, false).expect("it is measured").splats, 700, "what is set stays");
        assert!(matches!(measured(&settings, true), Err(TrainError::Stopped)));
        assert_eq!(more_points(&scene, 700).len(), 400);
    }

    #[test]
    fn one_slow_step_does_not_count() {
        let mut seconds = vec![9.0; 9];
        seconds.extend([0.1, 0.2, 7.0, 0.1, 0.2]);
        assert_eq!(typical(&seconds), 0.2);
        assert_eq!(typical(&[]), 0.0);
    }
}
