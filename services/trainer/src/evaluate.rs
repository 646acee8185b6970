//! Quality on photos that were held out (method, sections 3 and 10).

use crate::TrainError;
use crate::alignment::{RenderedDepth, align, depth_sum};
use crate::appearances::{self, LitPixel};
use crate::light::directions;
use crate::model::{Model, compose};
use crate::photos::{PhotoLevel, Photos, Stored, TrainPhotoCache};
use crate::posed::posed_view;
use segwild_nn::{Lpips, Map};
use segwild_objective::background::{Background, LEAST_SEEN, PRIOR_OF_HALF, SkySums};
use segwild_objective::{AffineAppearance, AnyAppearance, Appearance, HIDDEN_LAYER, RANK, psnr, ssim};
use segwild_raster::{Channels, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Scene, Splats, View};
use std::sync::Arc;

/// How a held-out photo is scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Protocol {
    /// The whole photo, with no appearance fitted to it.
    Plain,
    /// The appearance is fitted on the left half, the right half is scored (the official protocol of in-the-wild
    /// scenes). The pose is fitted there as well, if training photos were aligned to the splats.
    Halves,
}

/// Score of one photo.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewScore {
    /// Index of the view.
    pub view: usize,
    /// Its name.
    pub name: String,
    /// Peak signal-to-noise ratio in dB.
    pub psnr: f32,
    /// Structural similarity, 11-tap Gaussian window.
    pub ssim: f32,
    /// LPIPS, where its weights are given and what is scored is large enough for it; less is better.
    pub lpips: Option<f32>,
    /// PSNR in dB without the pixels that contradict the scene, as far as the photo may show transients.
    pub kept_psnr: f32,
    /// Share of the scored pixels that contradict it so.
    pub left_out: f32,
}

/// Scores of several photos.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    /// Per photo.
    pub views: Vec<ViewScore>,
    /// Mean PSNR in dB; 0 for no photo.
    pub psnr: f32,
    /// Mean SSIM; 0 for no photo.
    pub ssim: f32,
    /// Mean LPIPS over the photos that have one.
    pub lpips: Option<f32>,
    /// The renders scored, in the same order; the whole frame also where half of it is scored.
    pub renders: Vec<Image>,
}

/// Scores a model on some views; by LPIPS too, where its weights are given.
pub fn evaluate(
    model: &Model,
    engine: &dyn Rasterizer,
    scene: &Scene,
    photos: Arc<dyn Photos>,
    views: &[usize],
    protocol: Protocol,
    lpips: Option<&Lpips>,
) -> Result<Evaluation, TrainError> {
    let names = scene.views.iter().map(|v| v.name.clone()).collect();
    let mut cache = TrainPhotoCache::new(photos, names, 0);
    let mut out = Evaluation { views: Vec::new(), psnr: 0.0, ssim: 0.0, lpips: None, renders: Vec::new() };
    for &view in views {
        let stored = cache.get(view)?;
        let photo = &stored.levels[0];
        let w = photo.width;
        let left = |i: usize| i % w < w / 2;
        let fitted: Option<&(dyn Fn(usize) -> bool + Sync)> = match protocol {
            Protocol::Plain => None,
            Protocol::Halves => Some(&left),
        };
        let aligned = match fitted.filter(|_| model.is_aligned()) {
            Some(fitted) => aligned_unseen(model, engine, &scene.views[view], &stored, fitted)?,
            None => scene.views[view].clone(),
        };
        let Unseen { shown: render, .. } = render_unseen(model, engine, &aligned, &stored, 0, fitted)?;
        let from = if protocol == Protocol::Halves { w / 2 } else { 0 };
        let scored = |i: usize| i % w >= from;
        let (psnr, ssim) = score(&render, photo, scored);
        let lpips = lpips.and_then(|lpips| perceptual_score(lpips, &render, photo, from));
        let posed = posed_view(scene, view);
        let against = posed.contradicted(&render, photo, model.transient_shares[view]);
        let (kept_psnr, _) = score(&render, photo, |i| scored(i) && !against[i]);
        let count = |of: &(dyn Fn(usize) -> bool + Sync)| {
            (0..photo.pixels()).filter(|&i| scored(i) && photo.valid(i) && of(i)).count() as f32
        };
        let left_out = count(&|i| against[i]) / count(&|_| true).max(1.0);
        let name = scene.views[view].name.clone();
        out.views.push(ViewScore { view, name, psnr, ssim, lpips, kept_psnr, left_out });
        out.renders.push(render);
    }
    let n = out.views.len().max(1) as f32;
    out.psnr = out.views.iter().map(|v| v.psnr).sum::<f32>() / n;
    out.ssim = out.views.iter().map(|v| v.ssim).sum::<f32>() / n;
    let known: Vec<f32> = out.views.iter().filter_map(|v| v.lpips).collect();
    out.lpips = (!known.is_empty()).then(|| known.iter().sum::<f32>() / known.len() as f32);
    Ok(out)
}

/// LPIPS of a render, cut to the columns `from` on. Where a pixel of the photo is not valid the photo is taken for the render.
fn perceptual_score(lpips: &Lpips, render: &Image, photo: &PhotoLevel, from: usize) -> Option<f32> {
    let target = photo.image();
    let (width, height) = (photo.width - from, photo.height);
    let cut = |value: &dyn Fn(usize) -> f32| {
        let rows = (0..3 * height).flat_map(|row| (from..photo.width).map(move |x| row * photo.width + x));
        Map { channels: 3, height, width, data: rows.map(value).collect() }
    };
    let known = |k: usize| if photo.valid(k % photo.pixels()) { target.data[k] } else { render.data[k] };
    let distance = lpips.distance(&cut(&|k| render.data[k]), &cut(&known))?;
    Some(distance as f32)
}

/// PSNR in dB and SSIM of a render, over the photo's valid pixels `within`.
pub(crate) fn score(render: &Image, photo: &PhotoLevel, within: impl Fn(usize) -> bool) -> (f32, f32) {
    let scored = |i: usize| f32::from(u8::from(within(i) && photo.valid(i)));
    let data = (0..photo.pixels()).map(scored).collect();
    let mask = Image { width: photo.width, height: photo.height, channels: 1, data };
    let target = photo.image();
    (psnr(render, &target, Some(&mask)), ssim(render, &target, Some(&mask)))
}

/// The background fitted to what a photo shows `within` its sky and between splats; `None` where that is too little.
pub(crate) fn background_of(
    photo: &PhotoLevel,
    alpha: &Image,
    camera: &Camera,
    pose: &Pose,
    prior: f64,
    within: impl Fn(usize) -> bool + Sync,
) -> Option<Background> {
    let open = |i: usize| (1.0 - alpha.data[i]).max(0.0).powi(2);
    let seen = |i: usize| {
        let weight = if photo.sky(i) { 1.0 } else { open(i) };
        (within(i) && photo.valid(i) && weight > LEAST_SEEN).then(|| (photo.colour(i), weight))
    };
    Background::fit(SkySums::of(camera, pose, 2, seen), prior)
}

/// A view with its pose aligned to a scene on the pixels of its photo at which `fitted` holds, given the pixels of its full
/// size.
fn aligned_unseen(
    model: &Model,
    engine: &dyn Rasterizer,
    view: &View,
    stored: &Stored,
    fitted: &(dyn Fn(usize) -> bool + Sync),
) -> Result<View, TrainError> {
    let full = stored.level(0).1.width;
    let mut aligned = view.clone();
    for level in [2, 1] {
        let (level, photo) = stored.level(level);
        let camera = stored.camera(&view.camera, level);
        let within = |i: usize| fitted(((i / photo.width) << level) * full + ((i % photo.width) << level));
        let mut show = |camera: &Camera, pose: &Pose| {
            let at = View { pose: *pose, ..view.clone() };
            let Unseen { shown, alpha } = render_unseen(model, engine, &at, stored, level, Some(&within))?;
            let projected = engine.project(&model.splats, camera, pose, &model.options())?;
            Ok(RenderedDepth { shown, alpha, depth: depth_sum(&*projected, &model.splats.means, pose)? })
        };
        aligned.pose = align(aligned.pose, &camera, photo, &within, &mut show)?;
    }
    Ok(aligned)
}

/// The render from the camera of a photo that was not trained on.
pub(crate) struct Unseen {
    /// sRGB in [0, 1].
    pub shown: Image,
    /// Accumulated alpha: the share of the scene, not of the background.
    pub alpha: Image,
}

/// Renders one at a level of its size, with appearance and sky fitted to its pixels `fitted`; in the mean appearance
/// where none are to be fitted.
pub(crate) fn render_unseen(
    model: &Model,
    engine: &dyn Rasterizer,
    view: &View,
    stored: &Stored,
    level: usize,
    fitted: Option<&(dyn Fn(usize) -> bool + Sync)>,
) -> Result<Unseen, TrainError> {
    let photo = stored.level(level).1;
    let n = photo.pixels();
    let (camera, pose) = (stored.camera(&view.camera, level), view.pose);
    let projected = engine.project(&model.splats, &camera, &pose, &model.options())?;
    let colours = projected.shade();
    let blend = |count, values: &[f32]| projected.blend(&Channels { count, values });
    let frame = blend(3, &colours)?;
    let (mut appearance, mut index) = (model.appearance.clone(), model.appearance_index(None));
    let mut background = model.background(None);
    let mut tinted = None;
    let eye = pose.centre();
    let direction = directions(&model.splats, eye, projected.radii());
    if let Some(within) = fitted {
        if stored.has_sky {
            let sky = background_of(photo, &frame.alpha, &camera, &pose, PRIOR_OF_HALF, within);
            background = sky.unwrap_or(background);
        }
        let background_image = background.paint(&camera, &pose);
        let splat_embeddings = match &model.appearance {
            AnyAppearance::Embed(_) => blend(3 * RANK, &model.splat_embeddings)?.image,
            AnyAppearance::Gsw(appearance) => {
                blend(3 * RANK, &appearance.embeddings_below(&model.splat_embeddings))?.image
            }
            _ => Image::zeros(0, 0, 0),
        };
        let lit = |(scene, alpha, seen, i): ([f32; 3], f32, [f32; 3], usize)| {
            let light = std::array::from_fn(|k| splat_embeddings.data[k * n + i]);
            LitPixel { scene, alpha, light, seen }
        };
        let pairs = (0..n).filter(|&i| within(i) && photo.counts(i)).map(|i| {
            let (c, alpha) = (photo.colour(i), frame.alpha.data[i]);
            let scene = [0, 1, 2].map(|k| frame.image.data[k * n + i]);
            let seen = [0, 1, 2].map(|k| c[k] - (1.0 - alpha) * background_image.data[k * n + i]);
            (scene, alpha, seen, i)
        });
        match &model.appearance {
            AnyAppearance::None(_) => {}
            AnyAppearance::Affine(_) => {
                let mut fitted = AffineAppearance::new(1);
                fitted.set_matrix(
                    0,
                    appearances::fit(pairs.map(|(scene, alpha, seen, _)| (scene, alpha, seen, 1.0))),
                );
                (appearance, index) = (AnyAppearance::Affine(fitted), 0);
            }
            AnyAppearance::Embed(trained) => {
                let fitted = appearances::fit_embed(trained, &model.trained_on, pairs.map(lit));
                (appearance, index) = (AnyAppearance::Embed(fitted), 0);
            }
            AnyAppearance::Gsw(trained) => {
                // The network is conditioned on these pixels only, too.
                let image_conditioning =
                    appearances::image_conditioning(trained, photo, &camera, &pose, within);
                let light = trained.appearance_maps_of_conditioning(&image_conditioning);
                let Splats { means, .. } = &*model.splats;
                let below = trained.below.appearance_embedding(index, means, &model.splat_embeddings);
                let own = (&below, trained.layer());
                let appearance_embedding =
                    trained.appearance_embedding_of(&[(&light, 1.0)], own, means, &model.splat_embeddings);
                let activations =
                    blend(HIDDEN_LAYER, &trained.hidden_layer(&appearance_embedding, &direction))?.image;
                let pixels = pairs.map(|pair| {
                    let i = pair.3;
                    (lit(pair), std::array::from_fn(|k| activations.data[k * n + i]))
                });
                let (below, layer) = appearances::fit_gsw(trained, &model.trained_on, pixels);
                let own = (&below.appearance_embedding(0, means, &model.splat_embeddings), layer.as_slice());
                let appearance_embedding =
                    trained.appearance_embedding_of(&[(&light, 1.0)], own, means, &model.splat_embeddings);
                tinted = Some(trained.shade(
                    &appearance_embedding,
                    &model.splat_embeddings,
                    &direction,
                    colours.clone(),
                ));
            }
        }
    }
    let frame = match (&appearance, tinted) {
        (_, Some(tinted)) => blend(3, &tinted)?,
        (AnyAppearance::Embed(appearance), None) => {
            blend(3, &appearance.tint(index, &model.splat_embeddings, colours))?
        }
        (AnyAppearance::Gsw(appearance), None) => {
            let appearance_embedding =
                appearance.appearance_embedding(index, &model.splats.means, &model.splat_embeddings);
            blend(3, &appearance.shade(&appearance_embedding, &model.splat_embeddings, &direction, colours))?
        }
        _ => frame,
    };
    let shown = compose(&frame, &appearance, index, &background, &camera, &pose);
    Ok(Unseen { shown, alpha: frame.alpha })
}
