//! Splats that another program trained, in place of a training: placed in the world of the poses, with the appearance and the
//! background of each photo fitted to them. The splats stay as they are.

mod frame;
mod registration;

use crate::appearances::{self, AffineColour, IDENTITY};
use crate::evaluate::{background_of, score};
use crate::model::{self, Model, Stats};
use crate::photos::{PhotoLevel, Photos, Stored, TrainPhotoCache};
use crate::pixels::first_background;
use crate::trainer::{no_photos, photo_cache};
use crate::{AppearanceModel, TrainError, TrainSettings};
use segwild_objective::background::{Background, PRIOR};
use segwild_objective::{AffineAppearance, AnyAppearance, Engine, NoAppearance};
use segwild_raster::{Channels, Frame, Rasterizer};
use segwild_scene::{Camera, ImportedSplats, ReadSplats, Scene, Similarity, Skipped, Splats};
use std::sync::Arc;

/// Photos by which frames are compared, and the least long side at which they are, in pixels, where they are as large.
const COMPARED: usize = 6;
const SIDE: usize = 128;

/// What was made of imported splats.
pub(crate) struct ImportedModel {
    pub model: Model,
    /// Photos that turned out not to be usable.
    pub skipped: Vec<Skipped>,
    /// What was found and done, in words.
    pub notes: Vec<String>,
}

/// Progress of the fit: photos done, and the PSNR of the last one in dB.
pub(crate) type OnPhoto<'a> = dyn FnMut(u32, f32) -> Result<(), TrainError> + 'a;

/// Reads imported splats and fits the photos' appearance to them. `on_photo` is called after each photo, `alive` before each
/// render: its error ends the work.
pub(crate) fn fit(
    engine: &dyn Engine,
    scene: &Scene,
    imported: &ImportedSplats,
    photos: Arc<dyn Photos>,
    settings: &TrainSettings,
    alive: &dyn Fn() -> Result<(), TrainError>,
    on_photo: &mut OnPhoto<'_>,
) -> Result<ImportedModel, TrainError> {
    settings.check()?;
    let file = &imported.file;
    let ReadSplats { splats: own, mut notes } = file.read()?;
    let mut fitter = Fitter::new(engine, scene, photos, settings, alive);
    if fitter.views.is_empty() {
        return Err(TrainError::NoPhotos("the scene has none that is not held out".into()));
    }
    let sample = fitter.sample()?;
    let placed = |to: &Similarity| own.transformed(to).from_file_frame(&scene.frame);
    // Views of the splats themselves are rendered without compensation, unless the file says otherwise.
    let given = file.writer.antialias.or(imported.rendered.then_some(false));
    let modes = given.map_or(vec![false, true], |given| vec![given]);
    let found = frame::find(scene, &own, imported, &mut |to| {
        let splats = placed(to);
        modes.iter().try_fold(f64::NEG_INFINITY, |best, &mode| {
            Ok(best.max(fitter.explained(&splats, mode, &sample, SIDE)?))
        })
    })?;
    notes.push(found.note);
    let splats = placed(&found.to);
    let antialias = match given {
        Some(given) => given,
        None => {
            let whole = |mode: bool| fitter.explained(&splats, mode, &sample, usize::MAX);
            let [plain, compensated] = [whole(false)?, whole(true)?];
            if compensated > plain {
                notes.push("the photos are shown better with opacities compensated for the pixel filter: the splats are taken as antialiased".into());
            }
            compensated > plain
        }
    };
    drop(sample);
    let model = fitter.model(splats, antialias, on_photo)?;
    Ok(ImportedModel { model, skipped: fitter.skipped, notes })
}

/// A photo at the size at which frames are compared.
type ComparedPhoto = (usize, Arc<Stored>);

struct Fitter<'a> {
    engine: &'a dyn Engine,
    scene: &'a Scene,
    settings: &'a TrainSettings,
    alive: &'a dyn Fn() -> Result<(), TrainError>,
    cache: TrainPhotoCache,
    /// Views that are not held out and whose photos may be usable.
    views: Vec<usize>,
    skipped: Vec<Skipped>,
}

impl<'a> Fitter<'a> {
    fn new(
        engine: &'a dyn Engine,
        scene: &'a Scene,
        photos: Arc<dyn Photos>,
        settings: &'a TrainSettings,
        alive: &'a dyn Fn() -> Result<(), TrainError>,
    ) -> Fitter<'a> {
        let cache = photo_cache(scene, photos, settings);
        let mut views: Vec<usize> = (0..scene.views.len()).filter(|&view| !scene.views[view].test).collect();
        let refused = views.iter().filter_map(|&view| cache.refused(view));
        let skipped = refused.map(|(name, reason)| Skipped { name, reason }).collect();
        views.retain(|&view| cache.refused(view).is_none());
        Fitter { engine, scene, settings, alive, cache, views, skipped }
    }

    /// A few photos, evenly over the views.
    fn sample(&mut self) -> Result<Vec<ComparedPhoto>, TrainError> {
        let step = self.views.len().div_ceil(COMPARED).max(1);
        let mut sample = Vec::new();
        for &view in self.views.iter().skip(step / 2).step_by(step) {
            match self.cache.get(view) {
                Ok(stored) => sample.push((view, stored)),
                Err(TrainError::Photo { .. }) => {}
                Err(other) => return Err(other),
            }
        }
        Ok(sample)
    }

    /// The mean share of the photos' variance that splats explain, under a colour matrix for each photo, which has a
    /// long side of `side` pixels or little more.
    fn explained(
        &self,
        splats: &Splats,
        antialias: bool,
        sample: &[ComparedPhoto],
        side: usize,
    ) -> Result<f64, TrainError> {
        let resident = self.engine.upload_splats(splats)?;
        let engine: &dyn Rasterizer = resident.as_deref().unwrap_or(self.engine);
        let mut sum = 0.0;
        for (view, stored) in sample {
            let smaller = stored.levels.iter().filter(|level| level.width.max(level.height) >= side);
            let (level, photo) = stored.level(smaller.count().saturating_sub(1));
            let camera = stored.camera(&self.scene.views[*view].camera, level);
            let frame = self.render(engine, splats, antialias, *view, &camera)?;
            sum += explained(photo, &frame);
        }
        Ok(sum / sample.len().max(1) as f64)
    }

    fn render(
        &self,
        engine: &dyn Rasterizer,
        splats: &Splats,
        antialias: bool,
        view: usize,
        camera: &Camera,
    ) -> Result<Frame, TrainError> {
        (self.alive)()?;
        let projected =
            engine.project(splats, camera, &self.scene.views[view].pose, &model::options(antialias))?;
        let colours = projected.shade();
        Ok(projected.blend(&Channels { count: 3, values: &colours })?)
    }

    /// The model of splats in the scene's frame.
    fn model(
        &mut self,
        splats: Splats,
        antialias: bool,
        on_photo: &mut OnPhoto<'_>,
    ) -> Result<Model, TrainError> {
        let (scene, count) = (self.scene, self.scene.views.len());
        let one_light = self.settings.appearance_model == AppearanceModel::None;
        // Index `count` is the scene's own appearance, which is that of the file.
        let mut affine = AffineAppearance::new(count + 1);
        let mut backgrounds: Vec<Option<Background>> = vec![None; count];
        let (mut trained_on, mut quality) = (Vec::new(), Vec::new());
        let resident = self.engine.upload_splats(&splats)?;
        let engine: &dyn Rasterizer = resident.as_deref().unwrap_or(self.engine);
        for (done, view) in self.views.clone().into_iter().enumerate() {
            let stored = match self.cache.get(view) {
                Ok(stored) => stored,
                Err(TrainError::Photo { name, reason }) => {
                    self.skipped.push(Skipped { name, reason });
                    continue;
                }
                Err(other) => return Err(other),
            };
            let (level, photo) = stored.level(0);
            let (camera, pose) = (stored.camera(&scene.views[view].camera, level), scene.views[view].pose);
            let frame = self.render(engine, &splats, antialias, view, &camera)?;
            let fitted = background_of(photo, &frame.alpha, &camera, &pose, PRIOR, |_| true);
            let background = fitted.unwrap_or_else(|| first_background(&stored, &camera, &pose));
            if !one_light {
                affine.set_matrix(view, colour_matrix(photo, &frame, &background.paint(&camera, &pose).data));
            }
            let appearance = match one_light {
                true => AnyAppearance::None(NoAppearance),
                false => AnyAppearance::Affine(affine.clone()),
            };
            let shown = model::compose(&frame, &appearance, view, &background, &camera, &pose);
            let (psnr, _) = score(&shown, photo, |i| photo.counts(i));
            backgrounds[view] = Some(background);
            trained_on.push(view as u32);
            quality.push(psnr);
            on_photo(done as u32 + 1, psnr)?;
        }
        drop(resident);
        if trained_on.is_empty() {
            let skipped = std::mem::take(&mut self.skipped).into_iter();
            return Err(no_photos(&skipped.map(|s| (s.name, s.reason)).collect::<Vec<_>>()));
        }
        let share = self.settings.transient_share();
        let shown = |view: usize| if backgrounds[view].is_some() { share } else { 0.0 };
        let psnr = quality.iter().sum::<f32>() / quality.len() as f32;
        Ok(Model {
            splat_embeddings: Vec::new(),
            appearance: match one_light {
                true => AnyAppearance::None(NoAppearance),
                false => AnyAppearance::Affine(affine),
            },
            transient_shares: (0..count).map(shown).collect(),
            transient_evidence: vec![None; count],
            refined_poses: vec![None; count],
            names: scene.views.iter().map(|view| view.name.clone()).collect(),
            stats: Stats { step: trained_on.len() as u32, psnr: Some(psnr) },
            splats: Arc::new(splats),
            backgrounds,
            trained_on,
            antialias,
        })
    }
}

/// The colour matrix that leads from a frame to its photo, over a background in the photo's colours.
fn colour_matrix(photo: &PhotoLevel, frame: &Frame, background: &[f32]) -> AffineColour {
    let n = photo.pixels();
    appearances::fit((0..n).filter(|&i| photo.counts(i)).map(|i| {
        let (colour, alpha) = (photo.colour(i), frame.alpha.data[i]);
        let scene = [0, 1, 2].map(|k| frame.image.data[k * n + i]);
        let seen = [0, 1, 2].map(|k| colour[k] - (1.0 - alpha) * background[k * n + i]);
        (scene, alpha, seen, 1.0)
    }))
}

/// The share of a photo's variance that a frame explains, under the colour matrix that fits best, over the photo's mean colour.
fn explained(photo: &PhotoLevel, frame: &Frame) -> f64 {
    let n = photo.pixels();
    let counted: Vec<usize> = (0..n).filter(|&i| photo.counts(i)).collect();
    let mut mean = [0.0f64; 3];
    for &i in &counted {
        mean.iter_mut().zip(photo.colour(i)).for_each(|(sum, c)| *sum += f64::from(c));
    }
    let mean = mean.map(|sum| (sum / counted.len().max(1) as f64) as f32);
    let background: Vec<f32> = mean.iter().flat_map(|&c| std::iter::repeat_n(c, n)).collect();
    let matrix = colour_matrix(photo, frame, &background);
    let matrix = if matrix.iter().all(|v| v.is_finite()) { matrix } else { IDENTITY };
    let (mut off, mut spread) = (0.0, 0.0);
    for &i in &counted {
        let (colour, alpha) = (photo.colour(i), frame.alpha.data[i]);
        let x = [frame.image.data[i], frame.image.data[n + i], frame.image.data[2 * n + i], alpha];
        for k in 0..3 {
            let shown = (0..4).map(|j| matrix[4 * k + j] * x[j]).sum::<f32>() + (1.0 - alpha) * mean[k];
            off += f64::from(shown - colour[k]).powi(2);
            spread += f64::from(colour[k] - mean[k]).powi(2);
        }
    }
    if spread > 0.0 { 1.0 - off / spread } else { 0.0 }
}
