//! Appearance models: how a photo's light and camera change the colours (method, section 3).
//!
//! An appearance model acts at two stages: on the splats' colours before blending (`tint`) and on the blended image
//! (`apply`). `affine` acts on the image; `embed` and `gsw`, with a per-splat appearance embedding, act on the colours.
//!
//! Once trained, every model offers the same interface: an [`AppearanceEmbedding`] per photo, which may be interpolated
//! linearly, and a function from it and the splats' colours to colours (`shade`). Blending two photos' appearances,
//! strengthening one, applying one to an object alone and baking one into a file ([`bake`]) do not depend on the model.

mod affine;
mod bake;
mod embed;
pub mod gsw;

pub use affine::AffineAppearance;
pub(crate) use affine::{apply_matrix, matrix_backward};
pub use bake::bake;
pub use embed::{EmbedAppearance, EmbedLight, RANK};
pub use gsw::{
    AppearanceMaps, GswAppearance, GswWidth, HIDDEN_LAYER, HeldNetworks, ImageConditioning, UNetInput,
    VisibleSplats,
};

use segwild_scene::Image;
use std::ops::Range;
use wincode::{SchemaRead, SchemaWrite};

/// The appearance of photos, trained along with the splats.
///
/// Views are indices into [`segwild_scene::Scene::views`]. A view that the model does not know has the neutral
/// appearance.
pub trait Appearance: Send + Sync {
    /// Name of the appearance model.
    fn name(&self) -> &'static str;

    /// Number of trained parameters.
    fn parameters(&self) -> usize;

    /// Length of the appearance embedding of each splat; 0 without one.
    fn embedding_size(&self) -> usize {
        0
    }

    /// Which numbers of a splat embedding decay: a transient in one photo leaves values in them that other photos do
    /// not support.
    fn fading(&self) -> Range<usize> {
        0..0
    }

    /// Initial embeddings of splats at these centres.
    fn first_embeddings(&self, means: &[[f32; 3]]) -> Vec<f32> {
        vec![0.0; means.len() * self.embedding_size()]
    }

    /// Colours of the splats in a view, from their own colours, `[splat][r, g, b]`, and embeddings,
    /// `[splat][embedding_size]`.
    fn tint(&self, _view: usize, _embeddings: &[f32], colours: Vec<f32>) -> Vec<f32> {
        colours
    }

    /// From the gradient of [`Appearance::tint`]'s result to those of its colours and embeddings; keeps the gradient of
    /// the model's own parameters for [`Appearance::step`].
    fn tint_backward(
        &mut self,
        _view: usize,
        _embeddings: &[f32],
        _colours: &[f32],
        grad: Vec<f32>,
    ) -> (Vec<f32>, Vec<f32>) {
        (grad, Vec::new())
    }

    /// The image as the photo shows it, from the blended image (three planes).
    fn apply(&self, _view: usize, image: &Image) -> Image {
        image.clone()
    }

    /// From the gradient of [`Appearance::apply`]'s result to that of its input `image`; keeps the gradient of the
    /// model's own parameters for [`Appearance::step`].
    fn backward(&mut self, _view: usize, _image: &Image, grad: &Image) -> Image {
        grad.clone()
    }

    /// One optimiser step with the gradients kept since the last one. `scale` multiplies the learning rate.
    fn step(&mut self, scale: f32);

    /// The appearance embedding of a view, for splats with these centres and embeddings.
    fn appearance_embedding(
        &self,
        view: usize,
        means: &[[f32; 3]],
        splat_embeddings: &[f32],
    ) -> AppearanceEmbedding;

    /// Colours of the splats under this appearance embedding, from their own. Blended over the photo's background, they
    /// give the same image as [`Appearance::tint`] and [`Appearance::apply`] together: weights of splats and background
    /// add up to 1, so a map that is affine in the colours may be applied before blending or after.
    fn shade(
        &self,
        appearance_embedding: &AppearanceEmbedding,
        splat_embeddings: &[f32],
        direction: &Directions,
        colours: Vec<f32>,
    ) -> Vec<f32>;
}

/// The unit vector from the camera to each splat; `None` for one out of sight, which may get any colour.
pub type Directions<'a> = dyn Fn(usize) -> Option<[f32; 3]> + Sync + 'a;

/// The appearance of one photo as a vector; its layout depends on the model. Linear interpolation gives an appearance
/// again.
#[derive(Clone, Debug, PartialEq)]
pub struct AppearanceEmbedding(pub Vec<f32>);

impl AppearanceEmbedding {
    /// Interpolates linearly to another embedding: `t` = 0 is this one, 1 the other; past 1 it extrapolates.
    ///
    /// # Panics
    /// If the embeddings are not of the same model.
    pub fn towards(&self, other: &AppearanceEmbedding, t: f32) -> AppearanceEmbedding {
        assert_eq!(self.0.len(), other.0.len(), "embeddings of one model");
        // Exact at both ends.
        AppearanceEmbedding(self.0.iter().zip(&other.0).map(|(a, b)| a * (1.0 - t) + b * t).collect())
    }
}

/// Colours, `[splat][r, g, b]`, through a 3x4 matrix.
fn through(matrix: &[f32], colours: &mut [f32]) {
    for colour in colours.chunks_exact_mut(3) {
        let [r, g, b] = [colour[0], colour[1], colour[2]];
        for c in 0..3 {
            let row = &matrix[4 * c..4 * c + 4];
            colour[c] = row[0] * r + row[1] * g + row[2] * b + row[3];
        }
    }
}

/// The appearance model `none`: all photos show the scene as it is.
#[derive(Clone, Debug, Default, PartialEq, SchemaRead, SchemaWrite)]
pub struct NoAppearance;

impl Appearance for NoAppearance {
    fn name(&self) -> &'static str {
        "none"
    }

    fn parameters(&self) -> usize {
        0
    }

    fn step(&mut self, _: f32) {}

    fn appearance_embedding(&self, _: usize, _: &[[f32; 3]], _: &[f32]) -> AppearanceEmbedding {
        AppearanceEmbedding(Vec::new())
    }

    fn shade(&self, _: &AppearanceEmbedding, _: &[f32], _: &Directions, colours: Vec<f32>) -> Vec<f32> {
        colours
    }
}

/// Any of the appearance models, as it is stored.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub enum AnyAppearance {
    /// [`NoAppearance`].
    None(NoAppearance),
    /// [`AffineAppearance`].
    Affine(AffineAppearance),
    /// [`EmbedAppearance`].
    Embed(EmbedAppearance),
    /// [`GswAppearance`].
    Gsw(Box<GswAppearance>),
}

impl AnyAppearance {
    /// The model as a trait object.
    pub fn as_appearance(&self) -> &dyn Appearance {
        match self {
            AnyAppearance::None(appearance) => appearance,
            AnyAppearance::Affine(appearance) => appearance,
            AnyAppearance::Embed(appearance) => appearance,
            AnyAppearance::Gsw(appearance) => &**appearance,
        }
    }

    /// The model as a trait object, to be trained.
    pub fn as_appearance_mut(&mut self) -> &mut dyn Appearance {
        match self {
            AnyAppearance::None(appearance) => appearance,
            AnyAppearance::Affine(appearance) => appearance,
            AnyAppearance::Embed(appearance) => appearance,
            AnyAppearance::Gsw(appearance) => &mut **appearance,
        }
    }

    /// The maps that the UNet of `gsw` makes of a view's photo; `None` for the other models. `draw` is given in
    /// training and differs from step to step.
    pub fn appearance_maps(&self, view: usize, draw: Option<u64>) -> Option<AppearanceMaps> {
        match self {
            AnyAppearance::Gsw(appearance) => appearance.appearance_maps(view, draw),
            _ => None,
        }
    }

    /// Colours of the splats in sight in a view, from their own; `light` is [`AnyAppearance::appearance_maps`] of the view.
    pub fn colour(
        &self,
        view: usize,
        light: Option<&AppearanceMaps>,
        sight: &VisibleSplats,
        colours: Vec<f32>,
    ) -> Vec<f32> {
        match self {
            AnyAppearance::Gsw(appearance) => appearance.tint(view, light, sight, colours),
            _ => self.as_appearance().tint(view, sight.splat_embeddings, colours),
        }
    }

    /// From the gradient of [`AnyAppearance::colour`]'s result to those of its colours and embeddings; keeps the
    /// gradient of the model's own parameters for [`Appearance::step`]. `blame` as for
    /// [`GswAppearance::tint_backward`].
    pub fn colour_backward(
        &mut self,
        view: usize,
        light: Option<&AppearanceMaps>,
        sight: &VisibleSplats,
        colours: &[f32],
        grad: Vec<f32>,
        blame: &[Option<f32>],
    ) -> (Vec<f32>, Vec<f32>) {
        match self {
            AnyAppearance::Gsw(appearance) => {
                appearance.tint_backward(view, light, sight, colours, grad, blame)
            }
            _ => self.as_appearance_mut().tint_backward(view, sight.splat_embeddings, colours, grad),
        }
    }
}
