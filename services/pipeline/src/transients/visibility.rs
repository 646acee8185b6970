//! The visibility mask (VM) of a photo: its pixels that show the scene, and not sky, ignored areas or transients.

use super::corrections::Corrections;
use segwild_raster::Rasterizer;
use segwild_scene::statistics::upper_median;
use segwild_scene::{Mask, PhotoStore};
use segwild_trainer::{Model, TrainError, render_view};

/// Long side in pixels at which photos are compared with the scene.
const SIZE: u32 = 160;
/// Residuals under this (mean over channels, 0 to 1) never count as transient.
const HARMLESS: f32 = 0.12;
/// A pixel is transient when its residual is over this many times the photo's median residual.
const TOLERANCE: f32 = 4.0;

/// Computes the visibility mask of a view, on a grid whose long side has at most 160 cells. `sky` is the
/// photo's sky.
///
/// # Errors
/// When the photo cannot be loaded or the scene cannot be rendered.
pub fn visibility(
    model: &Model,
    engine: &dyn Rasterizer,
    photos: &PhotoStore,
    index: usize,
    sky: Option<&Mask>,
    transients: &Corrections,
) -> Result<Mask, TrainError> {
    let view = &photos.scene().views[index];
    let photo = photos
        .read(index)
        .map_err(|e| TrainError::Photo { name: view.name.clone(), reason: e.to_string() })?;
    let camera = view.camera.scaled_to(SIZE.min(photos.long_side()));
    let (w, h) = (camera.width as usize, camera.height as usize);
    let render = render_view(model, engine, &camera, &view.pose, Some(index))?;
    let small = photo.image.resized(w, h);
    let n = w * h;
    let residual: Vec<f32> = (0..n)
        .map(|i| (0..3).map(|c| (render.plane(c)[i] - small.plane(c)[i]).abs()).sum::<f32>() / 3.0)
        .collect();
    let usual = upper_median(residual.clone()).expect("a photo has pixels");
    let limit = (TOLERANCE * usual).max(HARMLESS);
    let sky = sky.map(|s| s.resized(camera.width, camera.height));
    let valid = photo.valid.as_ref().map(|v| v.resized(camera.width, camera.height));
    let corrected = transients.mask(index, camera.width, camera.height);
    let mut out = Mask::empty(camera.width, camera.height);
    for i in 0..n {
        // A transient is a blob: the mean over 3 x 3 must be off, not a lone edge pixel.
        let (x, y) = (i % w, i / w);
        let (mut sum, mut count) = (0.0, 0.0);
        for v in y.saturating_sub(1)..(y + 2).min(h) {
            for u in x.saturating_sub(1)..(x + 2).min(w) {
                sum += residual[v * w + u];
                count += 1.0;
            }
        }
        // A corrected mask decides over the residual.
        let shown = corrected.as_ref().map_or(sum / count <= limit, |c| !c.index(i));
        let barred = sky.as_ref().is_some_and(|s| s.index(i)) || valid.as_ref().is_some_and(|v| !v.index(i));
        out.set(x as u32, y as u32, shown && !barred);
    }
    Ok(out)
}
