//! Which look a scene needs: a guess from its points before any training, then short fits that are scored on photos
//! held out of them (method, section 9).

use crate::looks::{Affine, IDENTITY, fit};
use crate::{LookKind, Photos, Protocol, TrainError, TrainSettings, Trainer, evaluate};
use segwild_raster::Engine;
use segwild_scene::{Image, Scene};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The rungs that are tried, cheapest first. `gsw` is not among them: on `liberty` it is worth .15 dB over `embed` at three
/// times the step (docs/measured.md).
pub const RUNGS: [LookKind; 3] = [LookKind::None, LookKind::Affine, LookKind::Embed];

/// What a dearer rung must gain on the photos held out, in dB.
const WORTH: f32 = 0.15;
/// Share of the points' colour variance that an affine look must explain for photos to be taken to differ in light.
const DIFFERS: f32 = 0.3;
/// Long side of the photos that are looked at and tried on.
pub const SIZE: u32 = 160;
/// Steps of a short fit: a share of the whole training's, within these.
const STEPS: (u32, u32) = (300, 600);
/// Photos held out of the short fits: one in so many, and no more than this.
const HELD_OUT: (usize, usize) = (6, 10);
/// Photos looked at, at most: some of a large pile tell as much as all.
const MOST: usize = 80;
/// With fewer photos than this nothing can be held out.
const FEW: usize = 8;
/// Photos that must have seen a point for its colours to tell something.
const SEEN_BY: usize = 3;

/// How the colours of the reconstructed points differ between photos, as root mean squares in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tracks {
    /// Points looked at.
    pub points: usize,
    /// How far a point's colour in a photo is from its mean over photos.
    pub raw: f32,
    /// What of that stays when each photo has a colour matrix, fitted on half of its points and measured on the others.
    pub after_affine: f32,
}

impl Tracks {
    /// Share of the variance that the colour matrices explain.
    pub fn explained(&self) -> f32 {
        if self.raw > 0.0 { 1.0 - (self.after_affine / self.raw).powi(2) } else { 0.0 }
    }
}

/// Score of a short fit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShortFit {
    /// The rung.
    pub look: LookKind,
    /// Mean PSNR on the photos held out of it, in dB: the look fitted on the left half, the right half scored.
    pub psnr: f32,
    /// Mean SSIM.
    pub ssim: f32,
}

/// Which look was chosen, and on what grounds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LookChoice {
    /// The look.
    pub look: LookKind,
    /// Why, in a sentence.
    pub why: String,
    /// What the points say; `None` where too few were seen by several photos.
    pub tracks: Option<Tracks>,
    /// The fits that were tried, in the order in which they were.
    pub fits: Vec<ShortFit>,
    /// Photos that these were scored on.
    pub held_out: usize,
}

/// Chooses the lowest rung that suffices. `photos` gives photos of a long side of [`SIZE`]; `stopping` ends the work.
/// The same scene, photos and settings give the same choice.
pub fn choose_look(
    engine: Arc<dyn Engine>,
    scene: &Scene,
    photos: Arc<dyn Photos>,
    settings: &TrainSettings,
    stopping: &dyn Fn() -> bool,
) -> Result<LookChoice, TrainError> {
    let mut train: Vec<usize> = (0..scene.views.len()).filter(|&v| !scene.views[v].test).collect();
    let skip = train.len().div_ceil(MOST).max(1);
    train = train.into_iter().step_by(skip).collect();
    // One that cannot be read says nothing here, and is named where it is trained on.
    let usable: Vec<usize> = train.into_iter().filter(|&v| photos.photo(v).is_ok()).collect();
    let tracks = tracks(scene, &*photos, &usable);
    let guess = match tracks {
        Some(tracks) if tracks.explained() >= DIFFERS => 1,
        _ => 0,
    };
    let said = tracks.map_or("no points that several photos saw".to_owned(), |t| {
        format!(
            "the colours of {} points differ by {:.3} between photos, and by {:.3} after a colour matrix per photo",
            t.points, t.raw, t.after_affine
        )
    });
    if usable.len() < FEW {
        let look = RUNGS[guess];
        let why = format!("{look}: {said}; {} photos are too few to hold any out", usable.len());
        return Ok(LookChoice { look, why, tracks, fits: Vec::new(), held_out: 0 });
    }
    let mut apart = scene.clone();
    let every = HELD_OUT.0.max(usable.len().div_ceil(HELD_OUT.1));
    let held_out: Vec<usize> = usable.iter().copied().skip(every / 2).step_by(every).collect();
    for (view, v) in apart.views.iter_mut().enumerate() {
        v.test = v.test || held_out.contains(&view) || !usable.contains(&view);
    }
    let steps = (settings.steps / 8).clamp(STEPS.0, STEPS.1);
    let mut fits: Vec<ShortFit> = Vec::new();
    let mut score = |rung: usize| -> Result<f32, TrainError> {
        let look = RUNGS[rung];
        if let Some(done) = fits.iter().find(|fit| fit.look == look) {
            return Ok(done.psnr);
        }
        let short = TrainSettings { look, steps, ..settings.clone() };
        let mut trainer = Trainer::new(engine.clone(), &apart, photos.clone(), short)?;
        while !trainer.is_done() {
            if stopping() {
                return Err(TrainError::Stopped);
            }
            trainer.step()?;
        }
        let model = trainer.snapshot();
        let scored = evaluate(&model, &*engine, &apart, photos.clone(), &held_out, Protocol::Halves)?;
        fits.push(ShortFit { look, psnr: scored.psnr, ssim: scored.ssim });
        Ok(scored.psnr)
    };
    let mut rung = guess;
    // Up while it pays; if it did not pay at once, down while nothing is lost by it.
    while rung + 1 < RUNGS.len() && score(rung + 1)? - score(rung)? >= WORTH {
        rung += 1;
    }
    while rung > 0 && rung <= guess && score(rung)? - score(rung - 1)? < WORTH {
        rung -= 1;
    }
    let look = RUNGS[rung];
    let scores: Vec<String> = fits.iter().map(|fit| format!("{} {:.2} dB", fit.look, fit.psnr)).collect();
    let why = format!(
        "{look}: {said}; on {} photos held out of fits of {steps} steps: {}",
        held_out.len(),
        scores.join(", ")
    );
    Ok(LookChoice { look, why, tracks, fits, held_out: held_out.len() })
}

/// One sighting of a point: its photo, and the colour there.
struct Sighting {
    point: usize,
    colour: [f32; 3],
}

/// How the points' colours differ between photos; `None` with too few points.
fn tracks(scene: &Scene, photos: &dyn Photos, views: &[usize]) -> Option<Tracks> {
    let mut of_view: Vec<Vec<Sighting>> = Vec::new();
    let mut seen = vec![0usize; scene.points.len()];
    for &view in views {
        let photo = photos.photo(view).ok()?;
        let full = &scene.views[view].camera;
        let (w, h) = (photo.image.width as f32, photo.image.height as f32);
        let mut sightings = Vec::new();
        for (point, p) in scene.points.iter().enumerate() {
            let Some(o) = p.track.iter().find(|o| o.view as usize == view) else { continue };
            let (x, y) = (o.pixel[0] / full.width as f32 * w, o.pixel[1] / full.height as f32 * h);
            let inside = x >= 1.0 && y >= 1.0 && x < w - 1.0 && y < h - 1.0;
            let i = y as usize * photo.image.width + x as usize;
            if inside && photo.valid.as_ref().is_none_or(|m| m.index(i)) {
                seen[point] += 1;
                sightings.push(Sighting { point, colour: mean_around(&photo.image, x as usize, y as usize) });
            }
        }
        of_view.push(sightings);
    }
    for sightings in &mut of_view {
        sightings.retain(|s| seen[s.point] >= SEEN_BY);
    }
    let points = seen.iter().filter(|&&n| n >= SEEN_BY).count();
    if points < 50 {
        return None;
    }
    // Each point's colour in one light: first its mean, then what fits all photos' matrices best.
    let mut own = means(scene.points.len(), &of_view, &vec![IDENTITY; of_view.len()]);
    let raw = spread(&own, &of_view, &vec![IDENTITY; of_view.len()], |_| true);
    let mut matrices = Vec::new();
    for _ in 0..3 {
        matrices = of_view
            .iter()
            .map(|sightings| {
                let taught = sightings.iter().filter(|s| s.point % 2 == 0);
                fit(taught.map(|s| (own[s.point], 1.0, s.colour, 1.0)))
            })
            .collect();
        own = means(scene.points.len(), &of_view, &matrices);
    }
    let after_affine = spread(&own, &of_view, &matrices, |point| point % 2 == 1);
    Some(Tracks { points, raw, after_affine })
}

/// Mean over 3 x 3 pixels: a point is found to about a pixel.
fn mean_around(image: &Image, x: usize, y: usize) -> [f32; 3] {
    std::array::from_fn(|c| {
        let rows = y - 1..=y + 1;
        rows.flat_map(|v| (x - 1..=x + 1).map(move |u| image.at(c, u, v))).sum::<f32>() / 9.0
    })
}

/// Per point, the mean over its photos of the colour that the photo's matrix turns into the one seen.
fn means(points: usize, of_view: &[Vec<Sighting>], matrices: &[Affine]) -> Vec<[f32; 3]> {
    let mut sums = vec![([0.0f32; 3], 0.0f32); points];
    for (sightings, matrix) in of_view.iter().zip(matrices) {
        for s in sightings {
            let colour = crate::looks::undo(matrix, &[s.colour])[0];
            let (sum, n) = &mut sums[s.point];
            (0..3).for_each(|c| sum[c] += colour[c]);
            *n += 1.0;
        }
    }
    sums.into_iter().map(|(sum, n)| sum.map(|s| s / n.max(1.0))).collect()
}

/// Root mean square of what is seen beside what is expected, without the worst tenth: strangers, and points that a
/// photo was wrong to see.
fn spread(
    own: &[[f32; 3]],
    of_view: &[Vec<Sighting>],
    matrices: &[Affine],
    measured: impl Fn(usize) -> bool,
) -> f32 {
    let mut squares: Vec<f32> = Vec::new();
    for (sightings, m) in of_view.iter().zip(matrices) {
        for s in sightings.iter().filter(|s| measured(s.point)) {
            let o = own[s.point];
            let off = |c: usize| {
                m[4 * c] * o[0] + m[4 * c + 1] * o[1] + m[4 * c + 2] * o[2] + m[4 * c + 3] - s.colour[c]
            };
            squares.push((0..3).map(|c| off(c).powi(2)).sum::<f32>() / 3.0);
        }
    }
    squares.sort_by(f32::total_cmp);
    squares.truncate(squares.len() * 9 / 10);
    (squares.iter().map(|&s| f64::from(s)).sum::<f64>() / squares.len().max(1) as f64).sqrt() as f32
}
