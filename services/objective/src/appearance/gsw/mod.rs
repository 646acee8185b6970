//! The appearance model `gsw`: a network predicts the light of a photo from its image (GS-W; method, section 3).
//!
//! A UNet computes feature maps of the photo. A splat samples two of them at coordinates of its own, which are trained,
//! and a third where the splat projects into the photo: its dynamic appearance feature (`dynamic`). Small networks fuse
//! it with the intrinsic feature (`intrinsic`, trained per splat) into a vector that describes the splat's appearance
//! in this photo from any direction. A last network, the colour head, maps vector and direction to a colour. An
//! appearance embedding stores what the head's first layer computes from the vector alone.
//!
//! Differences from the paper: the predicted light is added to the colours of the base model, [`EmbedAppearance`]. So a
//! run of a thousand steps starts with the scene's colours and not with a network's noise, and what no network can read
//! in a photo (its exposure, a sun behind the camera) is fitted and not guessed. Mean and deviation of the photo's
//! colours bypass the UNet, because its norms would remove them. In some steps the UNet sees only a part of the photo,
//! so that it also works on half a photo.

mod appearance;
mod image_conditioning;
mod nets;
mod on_device;
mod points;

pub use appearance::{AppearanceMaps, BELOW, COORDINATE, EMBEDDING_SIZE, GswAppearance, VisibleSplats};
pub use image_conditioning::ImageConditioning;
pub use nets::{
    BESIDE, DYNAMIC, GswWidth, HIDDEN_LAYER, INTRINSIC, LAYER, MAPS, Networks, PLANES, SAMPLE, VECTOR,
};
pub use on_device::{TrainingNetworks, UNetInput};
pub use points::{DROPPED, OFF_MAP};

use super::affine::NUMBERS;
use super::model::{Appearance, AppearanceEmbedding, Directions};
use appearance::{GswGrads, WHOLE, below_of};
use segwild_nn::{Map, scatter, take};
use segwild_scene::{Image, Random, sigmoid};
use std::ops::Range;
use std::sync::Arc;

/// Share of the steps in which the UNet sees only a part of the photo.
const PARTLY: f32 = 0.4;
/// Share of the steps without predicted light, so that the scene is valid without it and the base model learns what it
/// can: with a tenth, held-out photos are half a dB worse.
const DARK: f32 = 0.5;
impl GswAppearance {
    /// The UNet's maps of a view's photo; `None` for a photo that is not known: no predicted light. `draw` is given in
    /// training and differs from step to step.
    pub fn appearance_maps(&self, view: usize, draw: Option<u64>) -> Option<AppearanceMaps> {
        let (image_conditioning, seen) = self.unet_input_of(view, draw)?;
        Some(self.appearance_maps_of(image_conditioning, seen, draw))
    }

    /// A view's photo, and the range of its columns that the UNet sees.
    fn unet_input_of(&self, view: usize, draw: Option<u64>) -> Option<(&Arc<ImageConditioning>, Range<f32>)> {
        let image_conditioning = self.image_conditionings.get(view)?.as_ref()?;
        let mut seen = WHOLE;
        if let Some(draw) = draw {
            let mut random = Random::stream(self.seed, draw);
            if random.uniform() < DARK {
                return None;
            }
            if random.uniform() < PARTLY {
                seen = if random.uniform() < 0.5 { 0.0..0.5 } else { 0.5..1.0 };
            }
        }
        Some((image_conditioning, seen))
    }

    /// The UNet's maps of a photo that is not one of the known views'.
    pub fn appearance_maps_of_conditioning(
        &self,
        image_conditioning: &Arc<ImageConditioning>,
    ) -> AppearanceMaps {
        self.appearance_maps_of(image_conditioning, WHOLE, None)
    }

    fn appearance_maps_of(
        &self,
        image_conditioning: &Arc<ImageConditioning>,
        seen: Range<f32>,
        draw: Option<u64>,
    ) -> AppearanceMaps {
        let whole = seen == WHOLE;
        let (image, beside) = image_conditioning.planes(seen);
        let unet = &self.nets().unet;
        let tape = unet.forward(&self.weights, image, beside);
        let maps = tape.of(unet.maps);
        AppearanceMaps {
            visible: tape.of(unet.plane).clone(),
            whole,
            maps: std::array::from_fn(|k| take(maps, k * SAMPLE, SAMPLE)),
            width: maps.width,
            height: maps.height,
            image_conditioning: image_conditioning.clone(),
            training: draw.map(|draw| (draw, Box::new(tape))),
        }
    }

    /// The appearance embedding of a weighted mix of photos, for splats with these centres and embeddings, on an
    /// appearance embedding of the base model and with a last layer. Without a photo there is no predicted light. The
    /// weight of a single photo scales its light.
    pub fn appearance_embedding_of(
        &self,
        photos: &[(&AppearanceMaps, f32)],
        (below, layer): (&AppearanceEmbedding, &[f32]),
        means: &[[f32; 3]],
        splat_embeddings: &[f32],
    ) -> AppearanceEmbedding {
        let kept = points::kept(self, photos, means, splat_embeddings);
        // The base model's offset of each splat, whatever its colour: embeddings are not evaluated again for every
        // image.
        let black = vec![0.0; 3 * means.len()];
        let own = self.below.shade(below, &below_of(splat_embeddings), &|_| Some([0.0; 3]), black);
        AppearanceEmbedding([&below.0[..NUMBERS], layer, &kept, &own].concat())
    }

    /// Activations of the colour head before its last layer, `[splat][HIDDEN_LAYER]`, under an appearance embedding.
    pub fn hidden_layer(
        &self,
        appearance_embedding: &AppearanceEmbedding,
        direction: &Directions,
    ) -> Vec<f32> {
        {
            let (kept, _) = split(&appearance_embedding.0[NUMBERS + LAYER..]);
            points::hidden_layer(self, kept, direction)
        }
    }

    /// Colours of the splats in sight in a view, from their own; `light` is [`GswAppearance::appearance_maps`] of the view.
    pub fn tint(
        &self,
        view: usize,
        light: Option<&AppearanceMaps>,
        sight: &VisibleSplats,
        colours: Vec<f32>,
    ) -> Vec<f32> {
        let colours = self.below.tint(view, &below_of(sight.splat_embeddings), colours);
        points::tint(self, light, sight, colours)
    }

    /// From the gradient of [`GswAppearance::tint`]'s result to those of its colours and embeddings; keeps the gradient
    /// of the model's own parameters for [`Appearance::step`]. [`AppearanceMaps::visible`] learns from `part_residuals`,
    /// one per part of the photo in its order: the residual there, relative to the limit for transients.
    pub fn tint_backward(
        &mut self,
        view: usize,
        light: Option<&AppearanceMaps>,
        sight: &VisibleSplats,
        colours: &[f32],
        grad: Vec<f32>,
        part_residuals: &[Option<f32>],
    ) -> (Vec<f32>, Vec<f32>) {
        let mut back = points::backward(self, light, sight, &grad);
        let (colour_grads, below) =
            self.below.tint_backward(view, &below_of(sight.splat_embeddings), colours, grad);
        for (to, from) in
            back.splat_embeddings.chunks_exact_mut(EMBEDDING_SIZE).zip(below.chunks_exact(BELOW))
        {
            to[EMBEDDING_SIZE - BELOW..].copy_from_slice(from);
        }
        let nets = self.nets();
        let mut weights = vec![0.0; self.weights.len()];
        weights[nets.border..].copy_from_slice(&back.weights);
        if let Some(AppearanceMaps { training: Some((_, tape)), width, height, visible, .. }) = light {
            let mut maps = Map::zeros(DYNAMIC, *height, *width);
            for (k, map) in back.maps.iter().enumerate() {
                scatter(map, &mut maps, k * SAMPLE, SAMPLE);
            }
            let plane = (part_residuals.len() == visible.data.len())
                .then(|| visibility_gradient(visible, part_residuals));
            nets.unet.backward(&self.weights, tape, maps, plane, &mut weights);
        }
        self.grads = Some(GswGrads { weights, layer: back.layer });
        (colour_grads, back.splat_embeddings)
    }
}

/// Weight of the visibility loss beside the colour loss.
pub const VISIBILITY: f32 = 0.1;

/// Gradient, before the sigmoid, of the mean of `b v + (1 - v)²` over the parts of the photo with a known `b`; `v` is
/// their visibility and `b` their residuals. The minimum is at `v = 1 - b / 2`.
fn visibility_gradient(plane: &Map, part_residuals: &[Option<f32>]) -> Map {
    let mut grad = Map::zeros(1, plane.height, plane.width);
    let known = part_residuals.iter().flatten().count().max(1) as f32;
    for ((to, from), residual) in grad.data.iter_mut().zip(&plane.data).zip(part_residuals) {
        if let Some(residual) = residual {
            let v = sigmoid(*from);
            *to = VISIBILITY / known * (residual.clamp(0.0, 2.0) - 2.0 * (1.0 - v)) * v * (1.0 - v);
        }
    }
    grad
}

impl AppearanceMaps {
    /// Visibility: the probability that each part of the photo shows the scene and no transient, in [0, 1], one plane
    /// at a quarter of the size of the UNet's input; `None` if the UNet has not seen the whole photo.
    pub fn visible(&self) -> Option<Image> {
        let Map { width, height, data, .. } = &self.visible;
        let data = data.iter().map(|&v| sigmoid(v)).collect();
        self.whole.then_some(Image { width: *width, height: *height, channels: 1, data })
    }
}

/// Splits the splats' part of an appearance embedding: the stored activations, and the base model's offsets.
fn split(splats: &[f32]) -> (&[f32], &[f32]) {
    splats.split_at(splats.len() / (HIDDEN_LAYER + 3) * HIDDEN_LAYER)
}

impl Appearance for GswAppearance {
    fn name(&self) -> &'static str {
        "gsw"
    }

    fn parameters(&self) -> usize {
        self.weights.len() + LAYER + self.below.parameters()
    }

    fn embedding_size(&self) -> usize {
        EMBEDDING_SIZE
    }

    /// The intrinsic feature stays, and coordinates have no neutral value to decay to.
    fn fading(&self) -> Range<usize> {
        EMBEDDING_SIZE - BELOW..EMBEDDING_SIZE
    }

    /// Initial embeddings: intrinsic feature 0, and coordinates that mix their positions, so that neighbours sample the
    /// same light.
    fn first_embeddings(&self, means: &[[f32; 3]]) -> Vec<f32> {
        let axis = |k: usize| {
            let mut values: Vec<f32> = means.iter().map(|m| m[k]).filter(|v| v.is_finite()).collect();
            values.sort_by(f32::total_cmp);
            let at = |share: f32| values.get((share * values.len() as f32) as usize).copied().unwrap_or(0.0);
            (at(0.02), at(0.98).max(at(0.02) + 1e-6))
        };
        let axes = [axis(0), axis(1), axis(2)];
        let mut random = Random::stream(self.seed, 0x636f_6f72);
        let mixes: [[f32; 3]; 2 * MAPS] = std::array::from_fn(|_| {
            let mix = [random.uniform(), random.uniform(), random.uniform()];
            let total = mix.iter().sum::<f32>().max(1e-3);
            mix.map(|v| v / total)
        });
        let mut out = vec![0.0; means.len() * EMBEDDING_SIZE];
        for (embedding, mean) in out.chunks_exact_mut(EMBEDDING_SIZE).zip(means) {
            let at: [f32; 3] = std::array::from_fn(|k| {
                let (low, high) = axes[k];
                (2.0 * (mean[k] - low) / (high - low) - 1.0).clamp(-1.0, 1.0)
            });
            for (to, mix) in embedding[INTRINSIC..EMBEDDING_SIZE - BELOW].iter_mut().zip(&mixes) {
                *to = (0..3).map(|k| mix[k] * at[k]).sum::<f32>() / COORDINATE;
            }
        }
        out
    }

    fn step(&mut self, scale: f32) {
        self.below.step(scale);
        let Some(GswGrads { weights, layer }) = self.grads.take() else { return };
        let border = self.nets().border;
        let (net, point) = self.weights.split_at_mut(border);
        self.net_moments.step(net, &weights[..border], self.net_rate * scale);
        self.point_moments.step(point, &weights[border..], self.point_rate * scale);
        self.layer_moments.step(&mut self.layer, &layer, self.point_rate * scale);
    }

    fn appearance_embedding(
        &self,
        view: usize,
        means: &[[f32; 3]],
        splat_embeddings: &[f32],
    ) -> AppearanceEmbedding {
        let light = self.appearance_maps(view, None);
        let lights: Vec<(&AppearanceMaps, f32)> = light.iter().map(|light| (light, 1.0)).collect();
        self.appearance_embedding_of(
            &lights,
            (&self.below.appearance_embedding(view, means, splat_embeddings), &self.layer),
            means,
            splat_embeddings,
        )
    }

    fn shade(
        &self,
        AppearanceEmbedding(appearance_embedding): &AppearanceEmbedding,
        _: &[f32],
        direction: &Directions,
        mut colours: Vec<f32>,
    ) -> Vec<f32> {
        assert_eq!(
            appearance_embedding.len(),
            NUMBERS + LAYER + colours.len() / 3 * (HIDDEN_LAYER + 3),
            "appearance embedding: length"
        );
        let (matrix, rest) = appearance_embedding.split_at(NUMBERS);
        let (layer, splats) = rest.split_at(LAYER);
        let (kept, own) = split(splats);
        points::add_light(self, kept, (matrix, own), layer, direction, &mut colours);
        colours
    }
}
