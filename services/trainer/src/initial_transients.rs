//! Transients before the training: found by cross-checking, so that the training cannot fit them as part of the scene.
//!
//! A training on a photo fits all that the photo shows, transients too: trousers become a haze before the camera, a
//! car a stain on the ground. What it has fitted no longer contradicts it. A training without the photo cannot fit its
//! transients. So the photos are divided among several short trainings: each leaves its part out, and then marks the pixels
//! of that part that contradict it.
//!
//! A short training has not learnt everything: what it could not build yet contradicts it as well. A location that
//! contradicts it in most of the photos that show it is undertrained, and no transient: a transient is in one photo only.

use crate::evaluate::{Unseen, render_unseen};
use crate::multi_view_pruning::votes;
use crate::photos::{Stored, TrainPhotoCache};
use crate::posed::Posed;
use crate::preparation_progress::{PreparationPart, PreparationProgress};
use crate::{AppearanceModel, Model, TrainError, TrainSettings, Trainer};
use segwild_objective::Engine;
use segwild_objective::transients::{INITIAL_TRANSIENT, relative};
use segwild_raster::{Channels, Projected, Rasterizer};
use segwild_scene::{Mask, Scene, box_mean};
use std::sync::Arc;

/// Steps of each training: a share of the whole training's, within these.
const STEPS: (u32, u32, u32) = (10, 100, 400);
/// Halvings of the photos.
const FINEST: usize = 1;
/// With fewer photos than this, too few are left to train on when a part is left out.
const FEW: usize = 20;
/// The same for photos of one light, which show transients only where the search finds some.
const FEW_OF_ONE_LIGHT: usize = 8;
/// The smallest blob, as a part of the photo's long side to each side, and how much of it must contradict.
const BLOB: usize = 24;
const SOLID: f32 = 0.8;
/// Share of the photos, by their light, in which a location contradicts the training when it is undertrained.
const UNDERTRAINED: f32 = 0.5;
/// Light that a location must have in other photos to be decided on, in photos.
const DECIDED: f32 = 0.5;
/// Least alpha of what can be decided, where a photo shows it.
const SHOWN: f32 = 0.2;

/// Mean share of the photos from which the masks are used. With 10 % covered .06 was found, where they neither help nor
/// harm; with 25 % .10, where they gain 1.3 dB.
const USED: f32 = 0.08;
/// Photos of one light show no transients when the mean share is below this: seven captured scenes and two synthetic ones
/// without transients have .001 to .023; with 5 % covered .036 was found, with 10 % .062.
const NONE: f32 = 0.03;
/// A photo whose share is at least this shows one all the same.
const ONE: f32 = 0.12;

/// Evidence of transients before the training.
pub(crate) struct InitialTransients {
    /// Per view, the pixels that contradict a training without the photo; `None` where nothing is known, or where they are
    /// too few in all to be used.
    pub masks: Vec<Option<Mask>>,
    /// Per view, the share of the photo that does so clearly and is not undertrained; `None` where nothing is known.
    pub shares: Vec<Option<f32>>,
}

impl InitialTransients {
    /// Of a scene with so many views, of which nothing is known.
    fn unknown(views: usize) -> InitialTransients {
        InitialTransients { masks: vec![None; views], shares: vec![None; views] }
    }

    /// Mean share over the photos of which something is known.
    pub fn mean_share(&self) -> Option<f32> {
        let known: Vec<f32> = self.shares.iter().flatten().copied().collect();
        (!known.is_empty()).then(|| known.iter().sum::<f32>() / known.len() as f32)
    }

    /// Per view, the largest share that the training may leave out as transient.
    ///
    /// Photos of one light are a capture in one session, which shows no transients unless the evidence says so. Photos of
    /// many lights are those of many people, who do not wait until nobody stands before them.
    pub fn robust_shares(&self, settings: &TrainSettings) -> Vec<f32> {
        let most = settings.robust_share;
        if !settings.robust || settings.cross_checks == 0 || !is_of_one_light(settings) {
            return vec![most; self.shares.len()];
        }
        let some = self.mean_share().is_some_and(|share| share >= NONE);
        let of = |share: &Option<f32>| if some || share.is_some_and(|s| s >= ONE) { most } else { 0.0 };
        self.shares.iter().map(of).collect()
    }
}

/// Whether the photos share one appearance.
fn is_of_one_light(settings: &TrainSettings) -> bool {
    settings.appearance_model == AppearanceModel::None
}

/// The trainings of the search in a scene of so many photos that are trained on.
pub(crate) fn search_count(settings: &TrainSettings, photos: usize) -> usize {
    let parts = settings.cross_checks as usize;
    let few = if is_of_one_light(settings) { FEW_OF_ONE_LIGHT } else { FEW };
    if !settings.robust || parts < 2 || photos < few { 0 } else { parts }
}

/// The steps of each before a training of so many.
pub(crate) fn search_steps(steps: u32) -> u32 {
    (steps / STEPS.0).clamp(STEPS.1, STEPS.2)
}

/// Searches for transients by [`TrainSettings::cross_checks`] short trainings. `follow` receives how far it is, and returns whether
/// to stop.
pub(crate) fn initial_transients(
    engine: &Arc<dyn Engine>,
    scene: &Scene,
    photos: &mut TrainPhotoCache,
    settings: &TrainSettings,
    follow: &dyn Fn(PreparationProgress) -> bool,
) -> Result<InitialTransients, TrainError> {
    let unknown = || InitialTransients::unknown(scene.views.len());
    let mut found = unknown();
    let train: Vec<usize> = (0..scene.views.len()).filter(|&v| !scene.views[v].test).collect();
    let parts = search_count(settings, train.len());
    if parts == 0 {
        return Ok(found);
    }
    let short = TrainSettings {
        steps: search_steps(settings.steps),
        sh_degree: settings.sh_degree.min(1),
        splats: 0,
        // It is not divided, and on photos at half size and with fewer colours takes less memory than the whole
        // training by blocks: a part of the splats would leave the scene undertrained.
        blocks: 1,
        appearance_model: if is_of_one_light(settings) {
            AppearanceModel::None
        } else {
            AppearanceModel::Affine
        },
        // What contradicts a training is seen without it.
        lambda_lpips: 0.0,
        ..settings.clone()
    };
    for part in 0..parts {
        let held: Vec<usize> = train.iter().copied().skip(part).step_by(parts).collect();
        let mut apart = scene.clone();
        held.iter().for_each(|&view| apart.views[view].test = true);
        let started = Trainer::start(engine.clone(), &apart, photos.take(), short.clone(), FINEST, &[]);
        let mut trainer = match started {
            // Too few can be read to leave any out; the training itself checks whether they are enough for it.
            Err(TrainError::NoPhotos(_)) => return Ok(unknown()),
            started => started?,
        };
        while !trainer.is_done() {
            let done = part * short.steps as usize + trainer.steps_done() as usize;
            let part = PreparationPart::ShortTrainings;
            if follow(PreparationProgress { part, done, total: parts * short.steps as usize }) {
                return Err(TrainError::Stopped);
            }
            match trainer.step() {
                Err(TrainError::NoPhotos(_)) => return Ok(unknown()),
                step => {
                    step?;
                }
            }
        }
        let model = trainer.snapshot()?;
        let posed = trainer.views;
        *photos = trainer.photos;
        let resident = engine.upload_splats(&model.splats)?;
        let renderer = resident.as_deref().unwrap_or(&**engine);
        let check = CrossCheck { engine: renderer, model: &model, scene, share: settings.robust_share };
        let before = (0..part).map(|part| train.len().saturating_sub(part).div_ceil(parts)).sum::<usize>();
        let checked = |done: usize| {
            let (part, done) = (PreparationPart::CrossChecks, before + done);
            follow(PreparationProgress { part, done, total: train.len() })
        };
        check.mark(&held, &posed, photos, &mut found, &checked)?;
    }
    if found.mean_share().is_none_or(|share| share < USED) {
        found.masks.fill(None);
    }
    Ok(found)
}

/// A short training, and the photos that it was made without.
struct CrossCheck<'a> {
    engine: &'a dyn Rasterizer,
    model: &'a Model,
    scene: &'a Scene,
    /// Largest share of a photo that may be transients.
    share: f32,
}

/// The pixels of a photo that contradict a training.
struct Contradiction {
    /// From [`INITIAL_TRANSIENT`] times the limit on.
    mask: Mask,
    /// From the limit on.
    clear: Mask,
}

impl CrossCheck<'_> {
    /// Marks what contradicts the training in the photos `held` out of it, and measures how much of it is not undertrained.
    /// `follow` receives the photos checked, and returns whether to stop.
    fn mark(
        &self,
        held: &[usize],
        posed: &[Posed],
        photos: &mut TrainPhotoCache,
        found: &mut InitialTransients,
        follow: &dyn Fn(usize) -> bool,
    ) -> Result<(), TrainError> {
        let go_on = |done| if follow(done) { Err(TrainError::Stopped) } else { Ok(()) };
        let mut contradictions = Vec::new();
        let mut votes = vec![[0.0f32; 2]; self.model.splats.len()];
        for (done, &view) in held.iter().enumerate() {
            go_on(done)?;
            // One that cannot be read is named where it is trained on.
            let Ok(stored) = photos.get(view) else { continue };
            let Some(contradiction) = self.contradiction(view, &posed[view], &stored)? else { continue };
            let projected = self.project(view, &stored)?;
            let own = self.votes(&*projected, &stored, &contradiction.mask)?;
            for (sum, own) in votes.iter_mut().zip(own) {
                *sum = [sum[0] + own[0], sum[1] + own[1]];
            }
            drop(projected);
            contradictions.push((view, contradiction));
        }
        for (view, Contradiction { mask, clear }) in contradictions {
            go_on(held.len())?;
            let Ok(stored) = photos.get(view) else { continue };
            let undertrained = self.undertrained(view, &stored, &mask, &votes)?;
            let transient = clear.minus(&undertrained);
            found.shares[view] = Some(transient.count() as f32 / (mask.width() * mask.height()) as f32);
            // With 25 % covered, what stands on the ground is where people stand in most photos: without those pixels the masks
            // are worth .9 dB less.
            found.masks[view] = Some(mask);
        }
        Ok(())
    }

    /// What contradicts the training in a photo.
    fn contradiction(
        &self,
        view: usize,
        posed: &Posed,
        stored: &Stored,
    ) -> Result<Option<Contradiction>, TrainError> {
        if stored.transients_known {
            return Ok(None);
        }
        let photo = stored.level(FINEST).1;
        let (w, n) = (photo.width, photo.pixels());
        let at = &self.scene.views[view];
        let Unseen { shown, alpha } =
            render_unseen(self.model, self.engine, at, stored, FINEST, Some(&|_| true))?;
        let mut residual = posed.residual(&shown, photo);
        // Where the scene is empty, a residual is no evidence.
        residual.iter_mut().zip(&alpha.data).for_each(|(r, alpha)| *r *= alpha);
        let ratio = relative(&residual, w, |i| photo.counts(i), self.share);
        let blobs = |limit: f32| {
            let over = |i: usize| f32::from(u8::from(photo.counts(i) && ratio[i] > limit));
            let over: Vec<f32> = (0..n).map(over).collect();
            // People and cars are blobs; residuals at edges, and where too few photos were left, are thin.
            let mean = |of: &[f32]| box_mean(of, w, photo.height, (w.max(photo.height) / BLOB).max(1));
            let solid: Vec<f32> = mean(&over).iter().map(|m| f32::from(u8::from(*m > SOLID))).collect();
            let near = mean(&solid);
            Mask::from_fn(w as u32, photo.height as u32, |x, y| {
                let i = y as usize * w + x as usize;
                near[i] > 0.0 && over[i] > 0.0
            })
        };
        Ok(Some(Contradiction { mask: blobs(INITIAL_TRANSIENT), clear: blobs(1.0) }))
    }

    /// The splats as a photo sees them.
    fn project(&self, view: usize, stored: &Stored) -> Result<Box<dyn Projected + '_>, TrainError> {
        let at = &self.scene.views[view];
        let camera = stored.camera(&at.camera, stored.level(FINEST).0);
        Ok(self.engine.project(&self.model.splats, &camera, &at.pose, &self.model.options())?)
    }

    /// The votes of one photo for and against each splat.
    fn votes(
        &self,
        projected: &dyn Projected,
        stored: &Stored,
        contradicted: &Mask,
    ) -> Result<Vec<[f32; 2]>, TrainError> {
        let photo = stored.level(FINEST).1;
        let contradicted: Vec<bool> = (0..photo.pixels()).map(|i| contradicted.index(i)).collect();
        Ok(votes(projected, photo.width, &contradicted, |i| photo.counts(i))?)
    }

    /// The pixels of a photo that show what contradicts the training in most of the other photos, and those that no other
    /// photo shows.
    fn undertrained(
        &self,
        view: usize,
        stored: &Stored,
        contradicted: &Mask,
        votes: &[[f32; 2]],
    ) -> Result<Mask, TrainError> {
        let projected = self.project(view, stored)?;
        let own = self.votes(&*projected, stored, contradicted)?;
        let others = votes.iter().zip(&own).flat_map(|(all, own)| {
            let (yes, no) = (all[0] - own[0], all[1] - own[1]);
            if yes + no > DECIDED { [no / (yes + no), 1.0] } else { [0.0; 2] }
        });
        let values: Vec<f32> = others.collect();
        let frame = projected.blend(&Channels { count: 2, values: &values })?;
        let (no, decided) = (frame.image.plane(0), frame.image.plane(1));
        let width = contradicted.width();
        Ok(Mask::from_fn(width, contradicted.height(), |x, y| {
            let i = (y * width + x) as usize;
            decided[i] <= SHOWN || no[i] >= UNDERTRAINED * decided[i]
        }))
    }
}
