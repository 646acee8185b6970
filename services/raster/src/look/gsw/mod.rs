//! The rung `gsw`: the light of a photo is what a network reads in it (GS-W; method, section 3).
//!
//! A UNet makes maps of the photo. A splat reads two of them at coordinates of its own, which are trained, and one where
//! the photo shows it: the light on it (`dynamic`). With what it is made of (`intrinsic`, trained per splat) small
//! networks fuse that into a vector, which says how the splat looks in this photo from any side, and is what is kept of
//! a look. A last network makes a colour of vector and direction.
//!
//! Where this goes beyond the paper: the colour is added to the splat's own, in the photo's colour matrix, as in
//! [`super::EmbedLook`]: a run of a thousand steps begins with the scene's colours and not with a network's noise, and
//! exposure is fitted, not guessed. What the last layer adds up may differ a little from photo to photo, for what a
//! network cannot read in a photo. The UNet also gets the mean and deviation of the photo's colours round its norms,
//! which would take them away. In some steps it sees a part of the photo only, so that it can be asked about half a photo.

mod glance;
mod nets;
mod points;

pub use glance::Glance;
pub use nets::{GswWidth, HIDDEN};

use super::affine::{IDENTITY, NUMBERS};
use super::{Look, Tone, through};
use crate::adam::Adam;
use nets::{DYNAMIC, INTRINSIC, LAYER, MAPS, Networks, SAMPLE, VECTOR};
use segwild_nets::{HeadTape, Map, Tape, scatter, take};
use segwild_scene::{Camera, Image, Pose, Random};
use std::ops::Range;
use std::sync::Arc;
use wincode::{SchemaRead, SchemaWrite};

/// Numbers of a splat's code: what it is made of, then its coordinates on each map.
const CODE: usize = INTRINSIC + 2 * MAPS;
/// How much faster a splat's coordinates move than the rest of its code: they are kept divided by this.
const COORDINATE: f32 = 0.3;
/// Share of the steps in which the UNet sees a part of the photo.
const PARTLY: f32 = 0.4;
/// Share of the steps in which no light is read, so that the scene without any is a scene.
const DARK: f32 = 0.1;
/// Size of the last layer's weights to start with, against those of the other layers: near the look below this one.
const QUIET: f32 = 0.02;

/// The networks, and what is kept of each photo.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct GswLook {
    /// Learning rate of matrices.
    pub rate: f32,
    /// Learning rate of the UNet.
    pub net_rate: f32,
    /// Learning rate of the small networks.
    pub point_rate: f32,
    /// Learning rate of what photos' last layers differ in.
    pub shift_rate: f32,
    /// Pull of matrices towards the identity, as in [`super::AffineLook`], and of last layers towards the common one.
    pub pull: f32,
    paper: bool,
    seed: u64,
    weights: Vec<f32>,
    net_moments: Adam,
    point_moments: Adam,
    /// The last layer of the colour head that is common to all photos.
    layer: Vec<f32>,
    layer_moments: Adam,
    photos: Vec<Photo>,
    /// Gradients since the last step.
    grads: Option<Grads>,
}

/// What is kept of a photo.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
struct Photo {
    matrix: [f32; NUMBERS],
    matrix_moments: Adam,
    /// What its last layer differs in from the common one, as that is laid out.
    shift: Vec<f32>,
    shift_moments: Adam,
    /// Shared with checkpoints and snapshots.
    glance: Option<Arc<Glance>>,
}

#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
struct Grads {
    view: u64,
    weights: Vec<f32>,
    matrix: [f32; NUMBERS],
    layer: Vec<f32>,
}

/// What the splats are, for a look that depends on more than their colours.
#[derive(Clone, Copy, Debug)]
pub struct Sight<'a> {
    /// Centres.
    pub means: &'a [[f32; 3]],
    /// What splats keep for the look, `[splat][code_size]`.
    pub codes: &'a [f32],
    /// Above 0 for splats in sight; the others need no colour.
    pub radii: &'a [f32],
    /// Where they are looked at from.
    pub eye: [f32; 3],
}

/// What the UNet made of a photo.
#[derive(Clone, Debug)]
pub struct Impression {
    /// The maps as splats read them: `[pixel][SAMPLE]` each.
    maps: [Vec<f32>; MAPS + 1],
    width: usize,
    height: usize,
    glance: Arc<Glance>,
    /// How sure the network is, before the sigmoid, that a part of the photo shows the scene.
    visible: HeadTape,
    /// Whether the network saw the whole photo.
    whole: bool,
    /// In training: what the step draws, and what the backward pass needs.
    training: Option<(u64, Box<Tape>)>,
}

impl GswLook {
    /// Networks drawn by `seed`, and identities for `views` photos.
    pub fn new(views: usize, seed: u64, width: GswWidth) -> GswLook {
        let nets = Networks::of(width);
        let mut random = Random::stream(seed, 0x6773_7721);
        let weights = nets.layout.begin(|| random.normal());
        let deviation = QUIET * (2.0 / HIDDEN as f32).sqrt();
        let layer = (0..LAYER).map(|k| if k < 3 * HIDDEN { deviation * random.normal() } else { 0.0 });
        let photo = Photo {
            matrix: IDENTITY,
            matrix_moments: Adam::new(1, NUMBERS),
            shift: vec![0.0; LAYER],
            shift_moments: Adam::new(1, LAYER),
            glance: None,
        };
        let moments = |n: usize| Adam::new(1, n).with(0.9, 0.999, 1e-8);
        GswLook {
            rate: 2e-3,
            net_rate: 2e-3,
            point_rate: 2e-3,
            shift_rate: 5e-3,
            pull: 1e-3,
            paper: width == GswWidth::Paper,
            seed,
            net_moments: moments(nets.border),
            point_moments: moments(weights.len() - nets.border),
            weights,
            layer: layer.collect(),
            layer_moments: moments(LAYER),
            photos: vec![photo; views],
            grads: None,
        }
    }

    fn nets(&self) -> &'static Networks {
        Networks::of(if self.paper { GswWidth::Paper } else { GswWidth::Cpu })
    }

    /// Whether its parts fit each other and `views` photos.
    pub fn consistent(&self, views: usize) -> bool {
        let nets = self.nets();
        let moments = [self.net_moments.len(), self.point_moments.len(), self.layer_moments.len()];
        let photo = |photo: &Photo| {
            let sizes = [photo.matrix_moments.len(), photo.shift.len(), photo.shift_moments.len()];
            sizes == [NUMBERS, LAYER, LAYER] && photo.glance.as_ref().is_none_or(|glance| glance.is_whole())
        };
        self.weights.len() == nets.layout.len()
            && moments == [nets.border, self.weights.len() - nets.border, LAYER]
            && self.layer.len() == LAYER
            && self.photos.len() == views
            && self.photos.iter().all(photo)
            && self.grads.is_none()
    }

    /// A photo's matrix, row by row; the identity for a photo that is not known.
    pub fn matrix(&self, view: usize) -> [f32; NUMBERS] {
        self.photos.get(view).map_or(IDENTITY, |photo| photo.matrix)
    }

    /// Sets a photo's matrix and forgets its optimiser's moments. Ignores photos that are not known.
    pub fn set_matrix(&mut self, view: usize, matrix: [f32; NUMBERS]) {
        if let Some(photo) = self.photos.get_mut(view) {
            photo.matrix = matrix;
            photo.matrix_moments = Adam::new(1, NUMBERS);
        }
    }

    /// The last layer of a photo's colour head: `[HIDDEN][3]`, then `[3]` offsets. The common one for a photo that is not
    /// known.
    pub fn layer(&self, view: usize) -> Vec<f32> {
        let Some(photo) = self.photos.get(view) else { return self.layer.clone() };
        self.layer.iter().zip(&photo.shift).map(|(common, shift)| common + shift).collect()
    }

    /// Sets the last layer of a photo's colour head and forgets its optimiser's moments. Ignores photos that are not
    /// known.
    ///
    /// # Panics
    /// If the layer has another length.
    pub fn set_layer(&mut self, view: usize, layer: &[f32]) {
        assert_eq!(layer.len(), LAYER, "layer: length");
        if let Some(photo) = self.photos.get_mut(view) {
            photo.shift = layer.iter().zip(&self.layer).map(|(own, common)| own - common).collect();
            photo.shift_moments = Adam::new(1, LAYER);
        }
    }

    /// A photo, at the size of the network. `colour` tells of each of its `size` pixels the colour, or that nothing is
    /// known of it.
    pub fn glance(
        &self,
        size: (usize, usize),
        camera: &Camera,
        pose: &Pose,
        colour: impl Fn(usize) -> Option<[f32; 3]>,
    ) -> Arc<Glance> {
        Arc::new(Glance::new(self.nets().side, size, camera, pose, colour))
    }

    /// Keeps what a photo shows. Ignores photos that are not known.
    pub fn set_glance(&mut self, view: usize, glance: Arc<Glance>) {
        if let Some(photo) = self.photos.get_mut(view) {
            photo.glance = Some(glance);
        }
    }

    /// Forgets what only training needs.
    pub fn forget_training(&mut self) {
        let nets = self.nets();
        self.net_moments = Adam::new(1, nets.border);
        self.point_moments = Adam::new(1, self.weights.len() - nets.border);
    }

    /// What the UNet makes of a view's photo; `None` for a photo that is not known: no light, the same for all.
    /// `draw` is given in training and differs from step to step.
    pub fn impression(&self, view: usize, draw: Option<u64>) -> Option<Impression> {
        let glance = self.photos.get(view)?.glance.as_ref()?;
        let mut seen = 0.0..1.0;
        if let Some(draw) = draw {
            let mut random = Random::stream(self.seed, draw);
            if random.uniform() < DARK {
                return None;
            }
            if random.uniform() < PARTLY {
                seen = if random.uniform() < 0.5 { 0.0..0.5 } else { 0.5..1.0 };
            }
        }
        Some(self.impression_of(glance, seen, draw))
    }

    /// What the UNet makes of a photo that is not one of the known views'.
    pub fn impression_of_glance(&self, glance: &Arc<Glance>) -> Impression {
        self.impression_of(glance, 0.0..1.0, None)
    }

    fn impression_of(&self, glance: &Arc<Glance>, seen: Range<f32>, draw: Option<u64>) -> Impression {
        let whole = seen == (0.0..1.0);
        let (image, beside) = glance.planes(seen);
        let tape = self.nets().unet.forward(&self.weights, image, &beside);
        Impression {
            visible: self.nets().visible.forward(&self.weights, tape.bottleneck()),
            whole,
            maps: std::array::from_fn(|k| take(&tape.maps, k * SAMPLE, SAMPLE)),
            width: tape.maps.width,
            height: tape.maps.height,
            glance: glance.clone(),
            training: draw.map(|draw| (draw, Box::new(tape))),
        }
    }

    /// What is particular to a mix of photos, each with its weight, seen with a matrix and a last layer, of splats with
    /// these centres and codes; no photo: without light. Weights of one photo other than 1 make its light stronger or
    /// weaker.
    pub fn tone_of(
        &self,
        photos: &[(&Impression, f32)],
        (matrix, layer): (&[f32; NUMBERS], &[f32]),
        means: &[[f32; 3]],
        codes: &[f32],
    ) -> Tone {
        let vectors = points::vectors(self, photos, means, codes);
        Tone([matrix, layer, &vectors].concat())
    }

    /// What the colour head has before its last layer, `[splat][HIDDEN]`, in a tone.
    pub fn hidden(&self, tone: &Tone, direction: &(dyn Fn(usize) -> [f32; 3] + Sync)) -> Vec<f32> {
        points::heads(self, &tone.0[NUMBERS + LAYER..], None, direction).concat()
    }

    /// Colours of the splats in sight in a view, from their own; `light` is [`GswLook::impression`] of the view.
    pub fn tint(
        &self,
        view: usize,
        light: Option<&Impression>,
        sight: &Sight,
        colours: Vec<f32>,
    ) -> Vec<f32> {
        points::tint(self, (&self.matrix(view), &self.layer(view)), light, sight, colours)
    }

    /// From the gradient of [`GswLook::tint`]'s result to those of its colours and codes; keeps the gradient of the
    /// look's own parameters for [`Look::step`]. `blame` is what [`Impression::visible`] is to learn from, of each part
    /// of the photo, in its order: how much of what would be taken for a stranger the scene fails to show there.
    pub fn tint_backward(
        &mut self,
        view: usize,
        light: Option<&Impression>,
        sight: &Sight,
        colours: &[f32],
        grad: Vec<f32>,
        blame: &[Option<f32>],
    ) -> (Vec<f32>, Vec<f32>) {
        let (matrix, layer) = (self.matrix(view), self.layer(view));
        let back = points::backward(self, (&matrix, &layer), light, sight, colours, grad);
        let nets = self.nets();
        let mut weights = vec![0.0; self.weights.len()];
        weights[nets.border..].copy_from_slice(&back.weights);
        if let Some(Impression { training: Some((_, tape)), width, height, visible, .. }) = light {
            let mut maps = Map::zeros(DYNAMIC, *height, *width);
            for (k, map) in back.maps.iter().enumerate() {
                scatter(map, &mut maps, k * SAMPLE, SAMPLE);
            }
            let bottleneck = (blame.len() == visible.plane.data.len()).then(|| {
                let grad = visibility_gradient(&visible.plane, blame);
                nets.visible.backward(&self.weights, visible, &grad, &mut weights)
            });
            nets.unet.backward(&self.weights, tape, &maps, bottleneck.as_ref(), &mut weights);
        }
        self.grads = Some(Grads { view: view as u64, weights, matrix: back.matrix, layer: back.layer });
        (back.colours, back.codes)
    }
}

/// Weight of what visibility learns beside the loss of colours.
const VISIBILITY: f32 = 0.1;

fn sigmoid(v: f32) -> f32 {
    1.0 / (1.0 + (-v).exp())
}

/// Gradient, before the sigmoid, of the mean of `b v + (1 - v)²` over the parts of the photo of which something is known;
/// `v` is their visibility and `b` what they are blamed for. Its least is at `v = 1 - b / 2`.
fn visibility_gradient(plane: &Map, blame: &[Option<f32>]) -> Map {
    let mut grad = Map::zeros(1, plane.height, plane.width);
    let known = blame.iter().flatten().count().max(1) as f32;
    for ((to, from), blame) in grad.data.iter_mut().zip(&plane.data).zip(blame) {
        if let Some(blame) = blame {
            let v = sigmoid(*from);
            *to = VISIBILITY / known * (blame.clamp(0.0, 2.0) - 2.0 * (1.0 - v)) * v * (1.0 - v);
        }
    }
    grad
}

impl Impression {
    /// How sure the network is that each part of the photo shows the scene and no stranger, in [0, 1], one plane of a
    /// quarter of the network's image; `None` if it has not seen the whole photo.
    pub fn visible(&self) -> Option<Image> {
        let Map { width, height, data, .. } = &self.visible.plane;
        let data = data.iter().map(|&v| sigmoid(v)).collect();
        self.whole.then_some(Image { width: *width, height: *height, channels: 1, data })
    }
}

impl Tone {
    /// The same light with another matrix and another last layer, of a tone of [`GswLook`].
    pub fn with(mut self, matrix: &[f32; NUMBERS], layer: &[f32]) -> Tone {
        self.0[..NUMBERS].copy_from_slice(matrix);
        self.0[NUMBERS..NUMBERS + LAYER].copy_from_slice(layer);
        self
    }
}

impl Look for GswLook {
    fn name(&self) -> &'static str {
        "gsw"
    }

    fn parameters(&self) -> usize {
        self.weights.len() + LAYER + self.photos.len() * (NUMBERS + LAYER)
    }

    fn code_size(&self) -> usize {
        CODE
    }

    /// Coordinates have no middle to fade to.
    fn code_fade(&self) -> f32 {
        0.0
    }

    /// What splats begin with: nothing of what they are made of, and coordinates that mix their positions, so that
    /// neighbours read the same light.
    fn first_codes(&self, means: &[[f32; 3]]) -> Vec<f32> {
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
        let mut out = vec![0.0; means.len() * CODE];
        for (code, mean) in out.chunks_exact_mut(CODE).zip(means) {
            let at: [f32; 3] = std::array::from_fn(|k| {
                let (low, high) = axes[k];
                (2.0 * (mean[k] - low) / (high - low) - 1.0).clamp(-1.0, 1.0)
            });
            for (to, mix) in code[INTRINSIC..].iter_mut().zip(&mixes) {
                *to = (0..3).map(|k| mix[k] * at[k]).sum::<f32>() / COORDINATE;
            }
        }
        out
    }

    fn step(&mut self, scale: f32) {
        let Some(Grads { view, weights, mut matrix, mut layer }) = self.grads.take() else { return };
        let border = self.nets().border;
        let (net, point) = self.weights.split_at_mut(border);
        self.net_moments.step(net, &weights[..border], self.net_rate * scale);
        self.point_moments.step(point, &weights[border..], self.point_rate * scale);
        self.layer_moments.step(&mut self.layer, &layer, self.point_rate * scale);
        if let Some(photo) = self.photos.get_mut(view as usize) {
            for k in 0..NUMBERS {
                matrix[k] += self.pull * (photo.matrix[k] - IDENTITY[k]);
            }
            photo.matrix_moments.step(&mut photo.matrix, &matrix, self.rate * scale);
            layer.iter_mut().zip(&photo.shift).for_each(|(grad, shift)| *grad += self.pull * shift);
            photo.shift_moments.step(&mut photo.shift, &layer, self.shift_rate * scale);
        }
    }

    fn tone(&self, view: usize, means: &[[f32; 3]], codes: &[f32]) -> Tone {
        let light = self.impression(view, None);
        let lights: Vec<(&Impression, f32)> = light.iter().map(|light| (light, 1.0)).collect();
        self.tone_of(&lights, (&self.matrix(view), &self.layer(view)), means, codes)
    }

    fn shade(
        &self,
        Tone(tone): &Tone,
        _: &[f32],
        direction: &(dyn Fn(usize) -> [f32; 3] + Sync),
        mut colours: Vec<f32>,
    ) -> Vec<f32> {
        assert_eq!(tone.len(), NUMBERS + LAYER + colours.len() / 3 * VECTOR, "tone: length");
        let (matrix, rest) = tone.split_at(NUMBERS);
        let (layer, vectors) = rest.split_at(LAYER);
        let more = points::heads(self, vectors, Some(layer), direction);
        through(matrix, &mut colours);
        colours.iter_mut().zip(more.iter().flatten()).for_each(|(colour, more)| *colour += more);
        colours
    }
}
