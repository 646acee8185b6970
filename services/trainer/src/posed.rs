//! The views of a training: their cameras, poses and points.

use crate::photos::{PhotoLevel, Stored};
use rayon::prelude::*;
use segwild_objective::compare::{mean_difference, untrusted};
use segwild_objective::transients::contradicted;
use segwild_scene::{Camera, Image, Point, Pose, Scene, TASK_PIXELS, View};
use std::sync::Arc;

/// Trust in the pixel of a point that the photo saw: a residual there counts for the rest.
const TRUST: f32 = 0.9;
/// Deviation of the bell around it, as a share of the photo's long side.
const NEARBY: f32 = 0.02;

/// A view in a training step.
pub(crate) struct Posed {
    pub name: String,
    /// At the photo's full size.
    pub camera: Camera,
    pub pose: Pose,
    /// Points this view saw: index of the colour, and position as shares of width and height.
    sightings: Vec<(u32, [f32; 2])>,
    /// sRGB colours of points, those of all views in one array.
    colours: Arc<[[f32; 3]]>,
}

impl Posed {
    /// How far each pixel is known to show the scene itself, in [0, [`TRUST`]]: near a point that this photo and others
    /// saw, whatever its residual, stands no transient.
    pub fn trusted(&self, photo: &PhotoLevel) -> Vec<f32> {
        let (w, h) = (photo.width, photo.height);
        let sigma = w.max(h) as f32 * NEARBY;
        let reach = (3.0 * sigma).ceil() as i32;
        let bell: Vec<f32> = (-reach..=reach).map(|d| (-0.5 * (d as f32 / sigma).powi(2)).exp()).collect();
        let mut out = vec![0.0f32; w * h];
        let rows = TASK_PIXELS.div_ceil(w.max(1));
        let bands = out.par_chunks_mut((rows * w).max(1)).enumerate();
        bands.for_each(|(band, out)| {
            let (top, bottom) = ((band * rows) as i32, (band * rows + out.len() / w) as i32);
            for (_, at) in &self.sightings {
                // Positions far outside are clamped: they reach no pixel either way, and the cast stays in range.
                let at = at.map(|v| v.clamp(-1.0, 2.0));
                let (cx, cy) = ((at[0] * w as f32) as i32, (at[1] * h as f32) as i32);
                let (left, right) = ((cx - reach).max(0), (cx + reach + 1).min(w as i32));
                if left >= right {
                    continue;
                }
                let across = &bell[(left - cx + reach) as usize..(right - cx + reach) as usize];
                for y in (cy - reach).max(top)..(cy + reach + 1).min(bottom) {
                    let down = bell[(y - cy + reach) as usize];
                    let row = &mut out[(y - top) as usize * w..][left as usize..right as usize];
                    for (o, near) in row.iter_mut().zip(across) {
                        *o = o.max(TRUST * (near * down));
                    }
                }
            }
        });
        out
    }
}

impl Posed {
    /// How far a photo is from a render of its view: the mean absolute colour difference of each pixel, weighted by the missing
    /// trust in it ([`Posed::trusted`]).
    pub fn residual(&self, shown: &Image, photo: &PhotoLevel) -> Vec<f32> {
        untrusted(&mean_difference(shown, &photo.image()), &self.trusted(photo))
    }

    /// Per pixel, whether a photo contradicts a render of its view. `share` is the most of the photo that may be transients;
    /// at 0 it contradicts nothing.
    pub fn contradicted(&self, shown: &Image, photo: &PhotoLevel, share: f32) -> Vec<bool> {
        if share <= 0.0 {
            return vec![false; photo.pixels()];
        }
        contradicted(&self.residual(shown, photo), photo.width, |i| photo.counts(i), share)
    }

    /// Number of points that it saw.
    pub fn sighted(&self) -> usize {
        self.sightings.len()
    }

    fn of(view: &View, colours: Arc<[[f32; 3]]>) -> Posed {
        let (name, sightings) = (view.name.clone(), Vec::new());
        Posed { name, camera: view.camera, pose: view.pose, sightings, colours }
    }

    /// Adds a sighting of the point of a colour, by its index.
    fn saw(&mut self, colour: usize, pixel: [f32; 2]) {
        let at = [pixel[0] / self.camera.width as f32, pixel[1] / self.camera.height as f32];
        self.sightings.push((colour as u32, at));
    }
}

pub(crate) fn posed(scene: &Scene) -> Vec<Posed> {
    let colours: Arc<[[f32; 3]]> = scene.points.iter().map(|point| point.colour).collect();
    let mut views: Vec<Posed> = scene.views.iter().map(|view| Posed::of(view, colours.clone())).collect();
    let mut counts = vec![0usize; views.len()];
    for seen in scene.points.iter().flat_map(|point| &point.track) {
        if let Some(count) = counts.get_mut(seen.view as usize) {
            *count += 1;
        }
    }
    // They stay for the whole training: lists that grow would hold up to twice their content.
    for (view, count) in views.iter_mut().zip(counts) {
        view.sightings.reserve_exact(count);
    }
    for (index, point) in scene.points.iter().enumerate() {
        for o in &point.track {
            if let Some(view) = views.get_mut(o.view as usize) {
                view.saw(index, o.pixel);
            }
        }
    }
    views
}

/// One of them.
pub(crate) fn posed_view(scene: &Scene, view: usize) -> Posed {
    let seen = |point: &Point| {
        let seen = point.track.iter().filter(|o| o.view as usize == view);
        seen.map(|o| (point.colour, o.pixel)).collect::<Vec<_>>()
    };
    let seen: Vec<([f32; 3], [f32; 2])> = scene.points.iter().flat_map(seen).collect();
    let mut posed = Posed::of(&scene.views[view], seen.iter().map(|(colour, _)| *colour).collect());
    for (index, (_, pixel)) in seen.into_iter().enumerate() {
        posed.saw(index, pixel);
    }
    posed
}

/// Colours of a view's points, and its photo's colours there.
pub(crate) fn colour_pairs(view: &Posed, stored: &Stored) -> Vec<([f32; 3], [f32; 3])> {
    let (_, photo) = stored.level(1);
    let (w, h) = (photo.width as f32, photo.height as f32);
    view.sightings
        .iter()
        .filter(|(_, at)| at.iter().all(|v| (0.0..1.0).contains(v)))
        .map(|(colour, at)| {
            (view.colours[*colour as usize], (at[1] * h) as usize * photo.width + (at[0] * w) as usize)
        })
        .filter(|&(_, i)| photo.counts(i))
        .map(|(colour, i)| (colour, photo.colour(i)))
        .collect()
}
