//! What the model holds: its networks, and the inputs and parameters of each photo.

use super::image_conditioning::ImageConditioning;
use super::nets::{GswWidth, HIDDEN_LAYER, INTRINSIC, LAYER, MAPS, Networks, PLANES};
use crate::adam::Adam;
use crate::appearance::embed::{EmbedAppearance, PHOTO};
use rayon::prelude::*;
use segwild_nn::{Map, Tape};
use segwild_scene::{Camera, Pose, Random};
use std::ops::Range;
use std::sync::Arc;
use wincode::{SchemaRead, SchemaWrite};

/// Numbers of a splat's embedding that belong to the base model, the last ones.
pub const BELOW: usize = EmbedAppearance::EMBEDDING_SIZE;
/// Length of a splat's embedding: intrinsic feature, coordinates on each map, and embedding of the base model.
pub const EMBEDDING_SIZE: usize = INTRINSIC + 2 * MAPS + BELOW;
/// How much faster a splat's coordinates learn than the rest of its embedding: they are stored divided by this.
pub const COORDINATE: f32 = 0.3;
/// All columns of a photo.
pub(super) const WHOLE: Range<f32> = 0.0..1.0;
/// Initial size of the last layer's weights against those of the other layers: the model starts near the base model.
const QUIET: f32 = 0.02;

/// The networks, and the inputs and parameters of each photo.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct GswAppearance {
    /// Matrices and vectors of the photos.
    pub below: EmbedAppearance,
    /// Learning rate of the UNet.
    pub net_rate: f32,
    /// Learning rate of the small networks.
    pub point_rate: f32,
    pub(super) paper: bool,
    pub(super) seed: u64,
    pub(super) weights: Vec<f32>,
    pub(super) net_moments: Adam,
    pub(super) point_moments: Adam,
    /// The last layer of the colour head.
    pub(super) layer: Vec<f32>,
    pub(super) layer_moments: Adam,
    /// The photos, shared with checkpoints and snapshots.
    pub(super) image_conditionings: Vec<Option<Arc<ImageConditioning>>>,
    /// Gradients since the last step.
    pub(super) grads: Option<GswGrads>,
}

#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(super) struct GswGrads {
    pub(super) weights: Vec<f32>,
    pub(super) layer: Vec<f32>,
}

/// The splats of a view, for an appearance model that depends on more than their colours.
#[derive(Clone, Copy, Debug)]
pub struct VisibleSplats<'a> {
    /// Centres.
    pub means: &'a [[f32; 3]],
    /// Per-splat appearance embeddings, `[splat][embedding_size]`.
    pub splat_embeddings: &'a [f32],
    /// Above 0 for splats in sight; the others need no colour.
    pub radii: &'a [f32],
    /// The camera's centre.
    pub eye: [f32; 3],
}

/// The maps that the UNet computes from a photo.
#[derive(Clone, Debug)]
pub struct AppearanceMaps {
    /// The maps in the layout that splats sample: `[pixel][SAMPLE]` each.
    pub(super) maps: [Vec<f32>; MAPS + 1],
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) image_conditioning: Arc<ImageConditioning>,
    /// Visibility logit of each part of the photo: whether it shows the scene.
    pub(super) visible: Map,
    /// Whether the network saw the whole photo.
    pub(super) whole: bool,
    /// In training: the step's random number, and the tape for the backward pass.
    pub(super) training: Option<(u64, Box<Tape>)>,
}

impl GswAppearance {
    /// Length of the embedding of a splat.
    pub const EMBEDDING_SIZE: usize = EMBEDDING_SIZE;

    /// Number of weights of networks of a width.
    pub fn weights(width: GswWidth) -> usize {
        Networks::of(width).layout.len()
    }

    /// Bytes that a photo takes in a model of a width, at most.
    pub fn photo_bytes(width: GswWidth) -> usize {
        let side = Networks::of(width).side;
        PLANES * side * side + 4 * 3 * PHOTO
    }

    /// Networks and vectors sampled by `seed`, and identities for `views` photos.
    pub fn new(views: usize, seed: u64, width: GswWidth) -> GswAppearance {
        let nets = Networks::of(width);
        let mut random = Random::stream(seed, 0x6773_7721);
        let weights = nets.layout.initial_weights(|| random.normal());
        let deviation = QUIET * (2.0 / HIDDEN_LAYER as f32).sqrt();
        let layer = (0..LAYER).map(|k| if k < 3 * HIDDEN_LAYER { deviation * random.normal() } else { 0.0 });
        let moments = |n: usize| Adam::new(1, n).with(0.9, 0.999, 1e-8);
        GswAppearance {
            below: EmbedAppearance::new(views, seed),
            net_rate: 2e-3,
            point_rate: 2e-3,
            paper: width == GswWidth::Paper,
            seed,
            net_moments: moments(nets.border),
            point_moments: moments(weights.len() - nets.border),
            weights,
            layer: layer.collect(),
            layer_moments: moments(LAYER),
            image_conditionings: vec![None; views],
            grads: None,
        }
    }

    /// How wide the networks are.
    pub fn width(&self) -> GswWidth {
        if self.paper { GswWidth::Paper } else { GswWidth::Cpu }
    }

    pub(super) fn nets(&self) -> &'static Networks {
        Networks::of(self.width())
    }

    /// Whether its parts fit each other and `views` photos.
    pub fn consistent(&self, views: usize) -> bool {
        let nets = self.nets();
        let moments = [self.net_moments.len(), self.point_moments.len(), self.layer_moments.len()];
        self.weights.len() == nets.layout.len()
            && moments == [nets.border, self.weights.len() - nets.border, LAYER]
            && self.layer.len() == LAYER
            && self.below.consistent(views)
            && self.image_conditionings.len() == views
            && self
                .image_conditionings
                .iter()
                .flatten()
                .all(|image_conditioning| image_conditioning.is_whole())
            && self.grads.is_none()
    }

    /// Splat embeddings of the base model, `[splat][EmbedAppearance::EMBEDDING_SIZE]`.
    pub fn embeddings_below(&self, splat_embeddings: &[f32]) -> Vec<f32> {
        below_of(splat_embeddings)
    }

    /// The last layer of the colour head: `[HIDDEN_LAYER][3]`, then `[3]` offsets.
    pub fn layer(&self) -> &[f32] {
        &self.layer
    }

    /// Sets the last layer of the colour head.
    ///
    /// # Panics
    /// If it has another length.
    pub fn set_layer(&mut self, layer: &[f32]) {
        self.layer.copy_from_slice(layer);
    }

    /// A photo at the size of the UNet. `colour` gives the colour of each of its `size` pixels, or `None` where it is
    /// unknown.
    pub fn image_conditioning(
        &self,
        size: (usize, usize),
        camera: &Camera,
        pose: &Pose,
        colour: impl Fn(usize) -> Option<[f32; 3]>,
    ) -> Arc<ImageConditioning> {
        Arc::new(ImageConditioning::new(self.nets().side, size, camera, pose, colour))
    }

    /// Stores the conditioning of a photo. Ignores photos that are not known.
    pub fn set_image_conditioning(&mut self, view: usize, image_conditioning: Arc<ImageConditioning>) {
        if let Some(slot) = self.image_conditionings.get_mut(view) {
            *slot = Some(image_conditioning);
        }
    }

    /// The gradients kept for the next step: of the networks' weights, and of the last layer's.
    pub fn gradients(&self) -> Option<[&[f32]; 2]> {
        self.grads.as_ref().map(|grads| [grads.weights.as_slice(), &grads.layer])
    }

    /// Drops the optimiser state, which only training needs.
    pub fn forget_training(&mut self) {
        let nets = self.nets();
        self.net_moments = Adam::new(1, nets.border);
        self.point_moments = Adam::new(1, self.weights.len() - nets.border);
    }
}

/// The embeddings of the base model, side by side.
pub(super) fn below_of(splat_embeddings: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0; splat_embeddings.len() / EMBEDDING_SIZE * BELOW];
    let pieces = out.par_chunks_mut(512 * BELOW).zip(splat_embeddings.par_chunks(512 * EMBEDDING_SIZE));
    pieces.for_each(|(to, from)| {
        for (to, from) in to.chunks_exact_mut(BELOW).zip(from.chunks_exact(EMBEDDING_SIZE)) {
            to.copy_from_slice(&from[EMBEDDING_SIZE - BELOW..]);
        }
    });
    out
}
