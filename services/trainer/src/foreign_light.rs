//! The light of a photo that is not in the scene, whose pose is not known.
//!
//! Renders of the views are laid over the photo, scaled and shifted, where they resemble it most. Where a render lies on the photo, its
//! colours are brought to the photo's by optimal transport: as a whole, since the pixels are not quite the same ones. What fits the
//! appearance of a posed photo, pixel by pixel, then fits these pairs. The network of `gsw` sees the photo itself, as if it had been
//! taken from the view that resembles it most.

use crate::TrainError;
use crate::appearances::{self, LitPixel};
use crate::light::{SceneLight, directions};
use crate::model::Model;
use crate::photos::{PhotoLevel, Stored, TrainPhoto};
use glam::{Mat3, Quat, Vec3};
use segwild_objective::background::Background;
use segwild_objective::{
    AffineAppearance, AnyAppearance, Appearance, AppearanceMaps, EmbedAppearance, HIDDEN_LAYER, RANK,
};
use segwild_raster::{Channels, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Scene};

/// Views whose renders are brought to the photo's colours.
const VIEWS: usize = 4;
/// Long side of these renders, in pixels.
const SIDE: u32 = 96;
/// Cells along the long side of the grids by which a photo and renders are compared.
const GRID: usize = 24;
/// Sizes of a cell of the photo in cells of a render.
const SCALES: [f32; 7] = [0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0];
/// Largest shift, in cells.
const SHIFT: i32 = 10;
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

/// The render of a view, in the scene's own light, and where it lies on the photo.
struct OverlaidRender {
    view: usize,
    camera: Camera,
    colours: Image,
    alpha: Image,
    overlay: PhotoOverlay,
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
        let references = references(model, engine, scene, whole)?;
        let Some(nearest) = references.first() else {
            let reason = "no view of the scene resembles it";
            return Err(TrainError::Photo { name: "the photo".into(), reason: reason.into() });
        };
        let name = scene.views[nearest.view].name.as_str();
        tracing::debug!(view = name, overlay = ?nearest.overlay, "the photo resembles a view");
        let camera = nearest.overlay.camera(&nearest.camera, whole.width, whole.height);
        let pose = scene.views[nearest.view].pose;
        let appearance = fit(model, engine, scene, &references, (whole, &camera, &pose))?;
        // Where in the sky the photo was taken towards is not known: it gets one colour.
        let sky: Vec<Vec3> =
            (0..whole.pixels()).filter(|&i| whole.sky(i)).map(|i| whole.colour(i).into()).collect();
        let mean = || sky.iter().sum::<Vec3>() / sky.len() as f32;
        let background = (!sky.is_empty()).then(|| Background::constant(mean().into()));
        Ok(ForeignLight { appearance, background })
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

/// Renders of the views that resemble the photo most, the nearest first.
fn references(
    model: &Model,
    engine: &dyn Rasterizer,
    scene: &Scene,
    photo: &PhotoLevel,
) -> Result<Vec<OverlaidRender>, TrainError> {
    let cells =
        FramingGrid::of(photo.width, photo.height, |i| photo.counts(i).then(|| luminance(photo.colour(i))));
    let mut found: Vec<OverlaidRender> = Vec::new();
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
        let overlay = cells.over(&FramingGrid::of(colours.width, colours.height, lit));
        if overlay.resemblance > 0.0 {
            found.push(OverlaidRender { view, camera, colours, alpha, overlay });
            found.sort_by(|a, b| b.overlay.resemblance.total_cmp(&a.overlay.resemblance));
            found.truncate(VIEWS);
        }
    }
    Ok(found)
}

fn luminance([r, g, b]: [f32; 3]) -> f32 {
    0.3 * r + 0.6 * g + 0.1 * b
}

/// Mean luminance in square cells of an image; `None` where most of a cell shows none of the scene.
struct FramingGrid {
    width: usize,
    height: usize,
    cells: Vec<Option<f32>>,
}

/// How a photo lies on a render.
#[derive(Clone, Copy, Debug)]
struct PhotoOverlay {
    /// Size of a cell of the photo, in cells of the render.
    scale: f32,
    /// Shift of the photo's middle from the render's, in cells of the render.
    shift: [f32; 2],
    /// 0 where they have nothing in common, 1 for equal images.
    resemblance: f32,
}

impl FramingGrid {
    fn of(width: usize, height: usize, of: impl Fn(usize) -> Option<f32>) -> FramingGrid {
        let side = width.max(height) as f32 / GRID as f32;
        let count = |pixels: usize| ((pixels as f32 / side).round() as usize).max(1);
        let (columns, rows) = (count(width), count(height));
        let mut cells = vec![(0.0, 0usize, 0usize); columns * rows];
        for i in 0..width * height {
            let (x, y) = (i % width * columns / width, i / width * rows / height);
            let (sum, shown, all) = &mut cells[y * columns + x];
            *all += 1;
            if let Some(value) = of(i) {
                *sum += value;
                *shown += 1;
            }
        }
        let mean = |(sum, shown, all): (f32, usize, usize)| (2 * shown > all).then(|| sum / shown as f32);
        FramingGrid { width: columns, height: rows, cells: cells.into_iter().map(mean).collect() }
    }

    /// Where this photo resembles a render most.
    fn over(&self, render: &FramingGrid) -> PhotoOverlay {
        let mut best = PhotoOverlay { scale: 1.0, shift: [0.0; 2], resemblance: 0.0 };
        for scale in SCALES {
            for (dx, dy) in (-SHIFT..=SHIFT).flat_map(|y| (-SHIFT..=SHIFT).map(move |x| (x, y))) {
                let at = PhotoOverlay { scale, shift: [dx as f32, dy as f32], resemblance: 0.0 };
                let resemblance = self.resemblance(render, &at);
                if resemblance > best.resemblance {
                    best = PhotoOverlay { resemblance, ..at };
                }
            }
        }
        best
    }

    /// How well the ranks of what both show correlate, times the share of the render on the photo that lies on no sky, times the fourth
    /// root of the share of what the photo shows that has a render: it may show much more than the scene, such as clouds. Ranks are the
    /// same in any light that keeps the order of what is bright.
    fn resemblance(&self, render: &FramingGrid, at: &PhotoOverlay) -> f32 {
        let (mut both, mut rendered, mut shown) = (Vec::new(), 0, 0);
        for (i, cell) in self.cells.iter().enumerate() {
            shown += usize::from(cell.is_some());
            let of = |k: usize, own: usize, other: usize, shift: f32| {
                (k as f32 + 0.5 - 0.5 * own as f32) * at.scale + 0.5 * other as f32 + shift
            };
            let x = of(i % self.width, self.width, render.width, at.shift[0]);
            let y = of(i / self.width, self.height, render.height, at.shift[1]);
            if x < 0.0 || y < 0.0 || x >= render.width as f32 || y >= render.height as f32 {
                continue;
            }
            let Some(value) = render.cells[y as usize * render.width + x as usize] else { continue };
            rendered += 1;
            if let Some(cell) = cell {
                both.push((*cell, value));
            }
        }
        // Fewer than a row of cells resemble anything.
        if both.len() < GRID {
            return 0.0;
        }
        let share = |of: usize, all: usize| of as f32 / all.max(1) as f32;
        let common = share(both.len(), rendered) * share(both.len(), shown).sqrt().sqrt();
        (0.5 + 0.5 * rank_correlation(&both)).powi(2) * common
    }
}

fn rank_correlation(pairs: &[(f32, f32)]) -> f32 {
    let ranks = |of: fn(&(f32, f32)) -> f32| {
        let mut order: Vec<usize> = (0..pairs.len()).collect();
        order.sort_by(|&i, &j| of(&pairs[i]).total_cmp(&of(&pairs[j])));
        let mut ranks = vec![0.0; pairs.len()];
        order.into_iter().enumerate().for_each(|(rank, i)| ranks[i] = rank as f32);
        ranks
    };
    let (x, y) = (ranks(|pair| pair.0), ranks(|pair| pair.1));
    let mean = (pairs.len() as f32 - 1.0) / 2.0;
    let moment = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - mean) * (b - mean)).sum::<f32>();
    moment(&x, &y) / moment(&x, &x).max(1e-6)
}

impl PhotoOverlay {
    /// Pixels of the render per pixel of a photo, and the render's pixel at which the photo's middle lies.
    fn pixels(&self, render: &Camera, width: usize, height: usize) -> (f32, [f32; 2]) {
        let cell = render.width.max(render.height) as f32 / GRID as f32;
        let own = width.max(height) as f32 / GRID as f32;
        let [dx, dy] = self.shift.map(|shift| shift * cell);
        (self.scale * cell / own, [0.5 * render.width as f32 + dx, 0.5 * render.height as f32 + dy])
    }

    /// The camera that shows on a photo of this size what the render shows where the photo lies.
    fn camera(&self, render: &Camera, width: usize, height: usize) -> Camera {
        let (scale, [x, y]) = self.pixels(render, width, height);
        Camera {
            width: width as u32,
            height: height as u32,
            fx: render.fx / scale,
            fy: render.fy / scale,
            cx: (render.cx - x) / scale + 0.5 * width as f32,
            cy: (render.cy - y) / scale + 0.5 * height as f32,
        }
    }

    /// The pixel of the photo at a pixel of the render; `None` outside of it.
    fn photo_pixel(&self, render: &Camera, photo: &PhotoLevel, at: usize) -> Option<usize> {
        let (scale, [mx, my]) = self.pixels(render, photo.width, photo.height);
        let (px, py) = (at % render.width as usize, at / render.width as usize);
        let x = (px as f32 + 0.5 - mx) / scale + 0.5 * photo.width as f32;
        let y = (py as f32 + 0.5 - my) / scale + 0.5 * photo.height as f32;
        let inside = x >= 0.0 && y >= 0.0 && x < photo.width as f32 && y < photo.height as f32;
        inside.then(|| y as usize * photo.width + x as usize)
    }
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
    references: &[OverlaidRender],
    (photo, camera, pose): (&PhotoLevel, &Camera, &Pose),
) -> Result<FittedAppearance, TrainError> {
    let colour = |reference: &OverlaidRender, i: usize| -> [f32; 3] {
        [0, 1, 2].map(|c| reference.colours.data[c * reference.alpha.pixels() + i])
    };
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
    let mut pixels: Vec<(LitPixel, [f32; HIDDEN_LAYER])> = Vec::new();
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
        let activations = match &conditioned {
            Some((trained, _, embedding)) => {
                let direction = directions(&model.splats, view_pose.centre(), projected.radii());
                blend(HIDDEN_LAYER, &trained.hidden_layer(embedding, &direction))?.image
            }
            None => Image::zeros(0, 0, 0),
        };
        let n = reference.alpha.pixels();
        let at = |image: &Image, k: usize, i: usize| image.data.get(k * n + i).copied().unwrap_or(0.0);
        let on_photo = |i: &usize| -> Option<(usize, Vec3)> {
            let at = reference.overlay.photo_pixel(&reference.camera, photo, *i)?;
            (reference.alpha.data[*i] > COVERED && photo.counts(at)).then(|| (*i, photo.colour(at).into()))
        };
        let common: Vec<(usize, Vec3)> = (0..n).filter_map(|i| on_photo(&i)).collect();
        let source: Vec<Vec3> = common.iter().map(|&(i, _)| colour(reference, i).into()).collect();
        let target: Vec<Vec3> = common.iter().map(|&(_, seen)| seen).collect();
        for (&(i, _), seen) in common.iter().zip(transported(&source, &target)) {
            let pixel = LitPixel {
                scene: colour(reference, i),
                alpha: reference.alpha.data[i],
                light: std::array::from_fn(|k| at(&embeddings, k, i)),
                seen: seen.into(),
            };
            pixels.push((pixel, std::array::from_fn(|k| at(&activations, k, i))));
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

    /// A hill with a pattern before the sky, as seen by a camera that is shifted and zoomed.
    fn framing(shift: f32, zoom: f32, light: fn(f32) -> f32) -> FramingGrid {
        FramingGrid::of(64, 48, |i| {
            let (x, y) = ((i % 64) as f32 - 32.0, (i / 64) as f32 - 24.0);
            let (x, y) = (x / zoom + shift, y / zoom);
            let value = 0.5 + 0.25 * (0.31 * x).sin() + 0.25 * (0.2 * x + 0.37 * y).cos();
            (y > -12.0 + 0.02 * x * x).then(|| light(value))
        })
    }

    #[test]
    fn a_photo_is_laid_where_it_resembles_a_render_in_any_light() {
        let night = framing(8.0, 1.6, |v| 0.02 + 0.1 * v * v);
        let at = night.over(&framing(0.0, 1.0, |v| v));
        assert!(at.resemblance > 0.8, "{at:?}");
        // A cell of the photo is 1 / 1.6 of a render's, and 8 pixels are two cells.
        assert!((at.scale - 0.63).abs() < 0.01 && (at.shift[0] - 2.0).abs() <= 1.0, "{at:?}");
        let nothing = FramingGrid::of(64, 48, |_| None);
        assert_eq!(nothing.over(&framing(0.0, 1.0, |v| v)).resemblance, 0.0);
    }

    #[test]
    fn the_camera_of_an_overlay_shows_what_the_render_shows_there() {
        let render = Camera { width: 96, height: 64, fx: 100.0, fy: 100.0, cx: 47.0, cy: 33.0 };
        let overlay = PhotoOverlay { scale: 0.8, shift: [2.0, -1.0], resemblance: 1.0 };
        let image = Image::filled(320, 240, 3, 0.5);
        let photo = TrainPhoto { image, valid: None, sky: None, transients: None };
        let stored = Stored::pack("a photo", &photo).expect("it is whole");
        let photo = &stored.levels[0];
        let camera = overlay.camera(&render, photo.width, photo.height);
        for (x, y) in [(50usize, 20usize), (70, 40)] {
            let at = overlay.photo_pixel(&render, photo, y * 96 + x).expect("it lies on the photo");
            let ray = |camera: &Camera, x: f32, y: f32| camera.ray(glam::Vec2::new(x, y));
            let off = ray(&render, x as f32 + 0.5, y as f32 + 0.5)
                - ray(&camera, (at % 320) as f32 + 0.5, (at / 320) as f32 + 0.5);
            assert!(off.length() < 0.01, "{off}");
        }
        assert_eq!(overlay.photo_pixel(&render, photo, 0), None);
    }
}
