//! The light of a photo that is not in the scene, whose pose is not known.
//!
//! Its colours are compared as a whole: renders of the views whose framing resembles the photo are brought to its colours by optimal
//! transport, sky aside. What fits the appearance of a posed photo, pixel by pixel, then fits these pairs. The network of `gsw` sees
//! the photo itself, as if it had been taken from the view that resembles it most.

use crate::TrainError;
use crate::appearances::{self, LitPixel};
use crate::evaluate::background_of;
use crate::light::{SceneLight, directions};
use crate::model::Model;
use crate::photos::{PhotoLevel, Stored, TrainPhoto};
use glam::{Mat3, Quat, Vec3};
use segwild_objective::background::{Background, PRIOR};
use segwild_objective::{
    AffineAppearance, AnyAppearance, Appearance, AppearanceMaps, EmbedAppearance, HIDDEN_LAYER, RANK,
};
use segwild_raster::{Channels, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Scene};

/// Views whose renders are brought to the photo's colours.
const VIEWS: usize = 4;
/// Long side of these renders, in pixels.
const SIDE: u32 = 96;
/// Cells along each side of the grid by which framings are compared.
const GRID: usize = 16;
/// Cover from which on a pixel of a render has the scene's colour.
const COVERED: f32 = 0.9;
/// Rotations of the colour space along whose axes colours are transported.
const ROTATIONS: u32 = 24;

/// The light of a photo that is not in the scene.
#[derive(Clone, Debug)]
pub struct ForeignLight {
    appearance: FittedAppearance,
    /// `None` where the photo shows no sky.
    background: Option<Background>,
}

/// An appearance that was fitted to one photo.
#[derive(Clone, Debug)]
enum FittedAppearance {
    /// The model has one light for all photos.
    None,
    Affine(AffineAppearance),
    Embed(EmbedAppearance),
    /// The part below the networks, the last layer of the colour head, and the network's maps of the photo.
    Gsw(EmbedAppearance, Vec<f32>, AppearanceMaps),
}

/// The render of a view, in the scene's own light.
struct Reference {
    view: usize,
    camera: Camera,
    colours: Image,
    alpha: Image,
}

impl ForeignLight {
    /// Fits a model's appearance to a photo. The photo's long side should be that of the training; its sky is not compared with splats.
    ///
    /// # Errors
    /// When the photo has no pixel that can be compared, or the engine fails.
    pub fn of(
        model: &Model,
        engine: &dyn Rasterizer,
        scene: &Scene,
        photo: &TrainPhoto,
    ) -> Result<ForeignLight, TrainError> {
        let stored = Stored::pack("the photo", photo)?;
        let whole = &stored.levels[0];
        let small = stored.levels.last().unwrap_or(whole);
        let target: Vec<Vec3> =
            (0..small.pixels()).filter(|&i| small.counts(i)).map(|i| small.colour(i).into()).collect();
        let references = references(model, engine, scene, small)?;
        let (Some(nearest), false) = (references.first(), target.is_empty()) else {
            let reason = "it shows nothing of the scene: all of it is sky";
            return Err(TrainError::Photo { name: "the photo".into(), reason: reason.into() });
        };
        let camera = scene.views[nearest.view].camera.resized(whole.width as u32, whole.height as u32);
        let pose = scene.views[nearest.view].pose;
        let background = stored.has_sky.then(|| {
            let covered = Image::filled(whole.width, whole.height, 1, 1.0);
            background_of(whole, &covered, &camera, &pose, PRIOR, |_| true)
        });
        let appearance = fit(model, engine, scene, &references, &target, (whole, &camera, &pose))?;
        Ok(ForeignLight { appearance, background: background.flatten() })
    }
}

impl Model {
    /// A foreign photo's light for these splats.
    pub fn foreign_light(&self, light: &ForeignLight) -> SceneLight {
        let means = &self.splats.means;
        let embedding = match &light.appearance {
            FittedAppearance::None => return self.light(None),
            FittedAppearance::Affine(affine) => affine.appearance_embedding(0, means, &self.splat_embeddings),
            FittedAppearance::Embed(embed) => embed.appearance_embedding(0, means, &self.splat_embeddings),
            FittedAppearance::Gsw(below, layer, maps) => match &self.appearance {
                AnyAppearance::Gsw(trained) => {
                    let below = below.appearance_embedding(0, means, &self.splat_embeddings);
                    let own = (&below, layer.as_slice());
                    trained.appearance_embedding_of(&[(maps, 1.0)], own, means, &self.splat_embeddings)
                }
                _ => return self.light(None),
            },
        };
        SceneLight::new(embedding, light.background.clone().unwrap_or_else(|| self.background(None)))
    }
}

/// Renders of the views that resemble the photo's framing most, the nearest first.
fn references(
    model: &Model,
    engine: &dyn Rasterizer,
    scene: &Scene,
    photo: &PhotoLevel,
) -> Result<Vec<Reference>, TrainError> {
    let framing = grid(photo.width, photo.height, |i| photo.counts(i).then(|| luminance(photo.colour(i))));
    let mut found: Vec<(f32, Reference)> = Vec::new();
    for &view in &model.trained_on {
        let view = view as usize;
        let camera = scene.views[view].camera.scaled_to(SIDE);
        let projected = engine.project(&model.splats, &camera, &scene.views[view].pose, &model.options())?;
        let frame = projected.blend(&Channels { count: 3, values: &projected.shade() })?;
        let (colours, alpha) = (frame.image, frame.alpha);
        let n = alpha.pixels();
        let lit = |i: usize| {
            (alpha.data[i] > COVERED).then(|| luminance([0, 1, 2].map(|c| colours.data[c * n + i])))
        };
        let resemblance = resemblance(&framing, &grid(colours.width, colours.height, lit));
        found.push((resemblance, Reference { view, camera, colours, alpha }));
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        found.truncate(VIEWS);
    }
    Ok(found.into_iter().map(|(_, reference)| reference).collect())
}

fn luminance([r, g, b]: [f32; 3]) -> f32 {
    0.3 * r + 0.6 * g + 0.1 * b
}

/// Mean luminance in the cells of a grid over an image; `None` where most of a cell shows none of the scene.
fn grid(width: usize, height: usize, of: impl Fn(usize) -> Option<f32>) -> Vec<Option<f32>> {
    let mut cells = vec![(0.0, 0usize, 0usize); GRID * GRID];
    for i in 0..width * height {
        let (x, y) = (i % width * GRID / width, i / width * GRID / height);
        let (sum, shown, all) = &mut cells[y * GRID + x];
        *all += 1;
        if let Some(value) = of(i) {
            *sum += value;
            *shown += 1;
        }
    }
    cells.into_iter().map(|(sum, shown, all)| (2 * shown > all).then(|| sum / shown as f32)).collect()
}

/// How much two framings resemble one another: the rank correlation of what both show, times the share that both show of what either
/// does. Ranks are the same in any light that keeps the order of what is bright.
fn resemblance(a: &[Option<f32>], b: &[Option<f32>]) -> f32 {
    let both: Vec<(f32, f32)> = a.iter().zip(b).filter_map(|(a, b)| Some(((*a)?, (*b)?))).collect();
    let either = a.iter().zip(b).filter(|(a, b)| a.is_some() || b.is_some()).count();
    let ranks = |of: fn(&(f32, f32)) -> f32| {
        let mut order: Vec<usize> = (0..both.len()).collect();
        order.sort_by(|&i, &j| of(&both[i]).total_cmp(&of(&both[j])));
        let mut ranks = vec![0.0; both.len()];
        order.into_iter().enumerate().for_each(|(rank, i)| ranks[i] = rank as f32);
        ranks
    };
    let (x, y) = (ranks(|pair| pair.0), ranks(|pair| pair.1));
    let mean = (both.len() as f32 - 1.0) / 2.0;
    let moment = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - mean) * (b - mean)).sum::<f32>();
    let correlation = moment(&x, &y) / moment(&x, &x).max(1e-6);
    (0.5 + 0.5 * correlation) * both.len() as f32 / either.max(1) as f32
}

/// Moves colours so that they are distributed as the target's: along the axes of rotated colour spaces, one after the other, the
/// ranks of the one take the values of the other (iterative distribution transfer, Pitié et al. 2007).
fn transported(source: &[Vec3], target: &[Vec3]) -> Vec<Vec3> {
    let mut moved = source.to_vec();
    for k in 0..ROTATIONS {
        let axes = Mat3::from_quat(rotation(k));
        let mut shift = vec![Vec3::ZERO; moved.len()];
        for axis in [axes.x_axis, axes.y_axis, axes.z_axis] {
            let mut order: Vec<usize> = (0..moved.len()).collect();
            let along: Vec<f32> = moved.iter().map(|colour| colour.dot(axis)).collect();
            order.sort_by(|&i, &j| along[i].total_cmp(&along[j]));
            let mut wanted: Vec<f32> = target.iter().map(|colour| colour.dot(axis)).collect();
            wanted.sort_by(f32::total_cmp);
            for (rank, i) in order.into_iter().enumerate() {
                let at = (rank as f32 + 0.5) / moved.len() as f32 * wanted.len() as f32;
                shift[i] += axis * (wanted[(at as usize).min(wanted.len() - 1)] - along[i]);
            }
        }
        moved.iter_mut().zip(shift).for_each(|(colour, shift)| *colour += shift);
    }
    moved
}

/// Rotations spread evenly; the first is none.
fn rotation(k: u32) -> Quat {
    /// Powers of the inverse of the real root of x⁴ = x + 1: a sequence of low discrepancy in three dimensions.
    const STEPS: [f32; 3] = [0.819_172_5, 0.671_043_6, 0.549_700_5];
    if k == 0 {
        return Quat::IDENTITY;
    }
    let [u, v, w] = STEPS.map(|step| (step * k as f32).fract());
    let turn = |x: f32| (std::f32::consts::TAU * x).sin_cos();
    let ((s1, c1), (s2, c2)) = (turn(v), turn(w));
    Quat::from_xyzw((1.0 - u).sqrt() * s1, (1.0 - u).sqrt() * c1, u.sqrt() * s2, u.sqrt() * c2)
}

/// Fits the model's appearance to renders whose colours were brought to those of the photo.
fn fit(
    model: &Model,
    engine: &dyn Rasterizer,
    scene: &Scene,
    references: &[Reference],
    target: &[Vec3],
    (photo, camera, pose): (&PhotoLevel, &Camera, &Pose),
) -> Result<FittedAppearance, TrainError> {
    let shown = |reference: &Reference| -> Vec<usize> {
        (0..reference.alpha.pixels()).filter(|&i| reference.alpha.data[i] > COVERED).collect()
    };
    let colour = |reference: &Reference, i: usize| -> [f32; 3] {
        [0, 1, 2].map(|c| reference.colours.data[c * reference.alpha.pixels() + i])
    };
    let source: Vec<Vec3> = references
        .iter()
        .flat_map(|reference| shown(reference).into_iter().map(|i| Vec3::from(colour(reference, i))))
        .collect();
    if source.is_empty() {
        let reason = "no view of the scene resembles it";
        return Err(TrainError::Photo { name: "the photo".into(), reason: reason.into() });
    }
    let wanted = transported(&source, target);
    let means = &model.splats.means;
    // What the networks see of the photo, and what they make of it before the fit.
    let conditioned = match &model.appearance {
        AnyAppearance::Gsw(trained) => {
            let conditioning = appearances::image_conditioning(trained, photo, camera, pose, |_| true);
            let maps = trained.appearance_maps_of_conditioning(&conditioning);
            let index = model.appearance_index(None);
            let below = trained.below.appearance_embedding(index, means, &model.splat_embeddings);
            let own = (&below, trained.layer());
            let embedding =
                trained.appearance_embedding_of(&[(&maps, 1.0)], own, means, &model.splat_embeddings);
            Some((trained, maps, embedding))
        }
        _ => None,
    };
    let mut pixels: Vec<(LitPixel, [f32; HIDDEN_LAYER])> = Vec::with_capacity(source.len());
    let mut seen = wanted.iter();
    for reference in references {
        let view_pose = &scene.views[reference.view].pose;
        let projected = engine.project(&model.splats, &reference.camera, view_pose, &model.options())?;
        let blend = |count: usize, values: &[f32]| projected.blend(&Channels { count, values });
        let embeddings = match &model.appearance {
            AnyAppearance::Embed(_) => blend(3 * RANK, &model.splat_embeddings)?.image,
            AnyAppearance::Gsw(trained) => {
                blend(3 * RANK, &trained.embeddings_below(&model.splat_embeddings))?.image
            }
            _ => Image::zeros(0, 0, 0),
        };
        let hidden = match &conditioned {
            Some((trained, _, embedding)) => {
                let direction = directions(&model.splats, view_pose.centre(), projected.radii());
                blend(HIDDEN_LAYER, &trained.hidden_layer(embedding, &direction))?.image
            }
            None => Image::zeros(0, 0, 0),
        };
        let n = reference.alpha.pixels();
        let at = |image: &Image, k: usize, i: usize| image.data.get(k * n + i).copied().unwrap_or(0.0);
        for i in shown(reference) {
            let Some(seen) = seen.next() else { break };
            let alpha = reference.alpha.data[i];
            let pixel = LitPixel {
                scene: colour(reference, i),
                alpha,
                light: std::array::from_fn(|k| at(&embeddings, k, i)),
                seen: (*seen).into(),
            };
            pixels.push((pixel, std::array::from_fn(|k| at(&hidden, k, i))));
        }
    }
    Ok(match (&model.appearance, conditioned) {
        (AnyAppearance::Affine(_), _) => {
            let pairs = pixels.iter().map(|(p, _)| (p.scene, p.alpha, p.seen, 1.0));
            let mut fitted = AffineAppearance::new(1);
            fitted.set_matrix(0, appearances::fit(pairs));
            FittedAppearance::Affine(fitted)
        }
        (AnyAppearance::Embed(trained), _) => {
            let pixels = pixels.iter().map(|(pixel, _)| *pixel);
            FittedAppearance::Embed(appearances::fit_embed(trained, &model.trained_on, pixels))
        }
        (AnyAppearance::Gsw(_), Some((trained, maps, _))) => {
            let (below, layer) = appearances::fit_gsw(trained, &model.trained_on, pixels.iter().copied());
            FittedAppearance::Gsw(below, layer, maps)
        }
        _ => FittedAppearance::None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn colours(count: usize, of: impl Fn(f32, f32, f32) -> [f32; 3]) -> Vec<Vec3> {
        let part = |k: usize, step: f32| (k as f32 * step).fract();
        (0..count).map(|k| of(part(k, 0.618_034), part(k, 0.754_878), part(k, 0.569_840)).into()).collect()
    }

    #[test]
    fn transported_colours_are_distributed_as_the_targets_in_every_direction() {
        let source = colours(3000, |a, b, c| [a, 0.5 * b, 0.3 + 0.2 * c]);
        let target = colours(2000, |a, b, c| [0.2 * a, 0.1 + 0.6 * a * b, 0.5 * c]);
        let moved = transported(&source, &target);
        for k in 0..7 {
            let axis = rotation(100 + k) * Vec3::X;
            let moments = |all: &[Vec3]| {
                let along = || all.iter().map(|c| f64::from(c.dot(axis)));
                let mean = along().sum::<f64>() / all.len() as f64;
                (mean, (along().map(|v| (v - mean).powi(2)).sum::<f64>() / all.len() as f64).sqrt())
            };
            let ((a, b), (c, d)) = (moments(&moved), moments(&target));
            assert!((a - c).abs() < 0.01 && (b - d).abs() < 0.01, "{axis}: {a} {b}, not {c} {d}");
        }
    }

    #[test]
    fn a_light_that_is_a_colour_matrix_is_found_again() {
        let source = colours(4000, |a, b, c| [0.8 * a * a, 0.6 * b, 0.2 + 0.5 * a * c]);
        let lit = |c: Vec3| Vec3::new(1.2 * c.x + 0.05, 0.9 * c.y, 0.6 * c.z + 0.02);
        // Another sample of the same scene.
        let target: Vec<Vec3> = colours(5000, |a, b, c| [0.8 * a * a, 0.6 * b, 0.2 + 0.5 * a * c])
            .into_iter()
            .skip(900)
            .map(lit)
            .collect();
        let pairs: Vec<_> = source.iter().copied().zip(transported(&source, &target)).collect();
        let fitted = appearances::fit(pairs.iter().map(|(a, b)| ((*a).into(), 1.0, (*b).into(), 1.0)));
        let off = source.iter().map(|&c| {
            let row = |r: usize| {
                fitted[4 * r] * c.x + fitted[4 * r + 1] * c.y + fitted[4 * r + 2] * c.z + fitted[4 * r + 3]
            };
            (Vec3::new(row(0), row(1), row(2)) - lit(c)).abs().max_element()
        });
        let worst = off.fold(0.0, f32::max);
        assert!(worst < 0.06, "{worst}");
    }

    #[test]
    fn framings_resemble_one_another_in_any_light_and_not_when_moved() {
        let framing = |shift: usize, light: fn(f32) -> f32| {
            grid(64, 48, |i| {
                let (x, y) = (i % 64 + shift, i / 64);
                let value = ((x * 7 + y * 3) % 41) as f32 / 41.0 * 0.3 + (x as f32 / 90.0).sin().abs() * 0.7;
                (y > 8 + x / 8).then(|| light(value))
            })
        };
        let day = framing(0, |v| v);
        let night = resemblance(&day, &framing(0, |v| 0.02 + 0.1 * v * v));
        let moved = resemblance(&day, &framing(40, |v| v));
        assert!(night > 0.98 && moved < 0.8, "{night}, {moved}");
    }
}
