//! What a photo's light and camera do to the colours (method, section 3).
//!
//! A look has two places to act: on the splats' colours before they are blended (`tint`) and on the blended
//! image (`apply`). `affine` acts on the image; `embed`, for which splats have codes of their own, on the colours.
//!
//! Once it is trained, a look of any rung is the same kind of thing: a [`AppearanceEmbedding`] per photo, numbers between which one goes
//! in a straight line, and what a tone makes of the splats' colours (`shade`). Blending two photos' looks, strengthening
//! one, putting one on an object alone and writing one into a file ([`bake`]) know nothing of rungs.

mod affine;
mod bake;
mod embed;
pub mod gsw;

pub use affine::AffineAppearance;
pub(crate) use affine::{apply_matrix, matrix_backward};
pub use bake::bake;
pub use embed::{EmbedAppearance, Light, RANK};
pub use gsw::{
    AppearanceMaps, GswAppearance, GswWidth, HIDDEN_LAYER, HeldNetworks, ImageConditioning, Sight, UNetInput,
};

use segwild_scene::Image;
use std::ops::Range;
use wincode::{SchemaRead, SchemaWrite};

/// The appearance of photos, trained along with the splats.
///
/// Views are indices into [`segwild_scene::Scene::views`]. A view that the look does not know has the neutral
/// appearance.
pub trait Appearance: Send + Sync {
    /// Name of the rung.
    fn name(&self) -> &'static str;

    /// Number of trained parameters.
    fn parameters(&self) -> usize;

    /// Numbers that each splat has for this look beside its colour: its code.
    fn embedding_size(&self) -> usize {
        0
    }

    /// Which numbers of a code fade where nothing needs them: what a transient in one photo leaves in them, others do not
    /// confirm.
    fn fading(&self) -> Range<usize> {
        0..0
    }

    /// Codes of splats at these centres to begin with.
    fn first_embeddings(&self, means: &[[f32; 3]]) -> Vec<f32> {
        vec![0.0; means.len() * self.embedding_size()]
    }

    /// Colours of the splats in a view, from their own colours, `[splat][r, g, b]`, and codes,
    /// `[splat][embedding_size]`.
    fn tint(&self, _view: usize, _embeddings: &[f32], colours: Vec<f32>) -> Vec<f32> {
        colours
    }

    /// From the gradient of [`Appearance::tint`]'s result to those of its colours and its codes; keeps the gradient of the
    /// look's own parameters for [`Appearance::step`].
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
    /// look's own parameters for [`Appearance::step`].
    fn backward(&mut self, _view: usize, _image: &Image, grad: &Image) -> Image {
        grad.clone()
    }

    /// One optimiser step with the gradients kept since the last one. `scale` multiplies the learning rate.
    fn step(&mut self, scale: f32);

    /// What is particular to a view, of splats with these centres and codes.
    fn appearance_embedding(
        &self,
        view: usize,
        means: &[[f32; 3]],
        splat_embeddings: &[f32],
    ) -> AppearanceEmbedding;

    /// Colours of the splats as a photo of this tone shows them, from their own. Blended, over the photo's background,
    /// they are what [`Appearance::tint`] and [`Appearance::apply`] make of the view together: weights of splats and background add
    /// up to 1, so what is affine in the colours may be done before blending or after.
    fn shade(
        &self,
        appearance_embedding: &AppearanceEmbedding,
        splat_embeddings: &[f32],
        direction: &Directions,
        colours: Vec<f32>,
    ) -> Vec<f32>;
}

/// The unit vector from the camera to each splat; `None` of one that nobody sees, which may be given any colour.
pub type Directions<'a> = dyn Fn(usize) -> Option<[f32; 3]> + Sync + 'a;

/// What one photo's look comes to, as numbers; which, the rung knows. Straight lines between tones are looks again.
#[derive(Clone, Debug, PartialEq)]
pub struct AppearanceEmbedding(pub Vec<f32>);

impl AppearanceEmbedding {
    /// The tone a share `t` of the way to another; past 1 it goes on beyond it.
    ///
    /// # Panics
    /// If the tones are not of the same look.
    pub fn towards(&self, other: &AppearanceEmbedding, t: f32) -> AppearanceEmbedding {
        assert_eq!(self.0.len(), other.0.len(), "tones of one look");
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

/// The rung `none`: all photos show the scene as it is.
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

/// A look of any rung, as it is stored.
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
    /// The look behind it.
    pub fn as_appearance(&self) -> &dyn Appearance {
        match self {
            AnyAppearance::None(appearance) => appearance,
            AnyAppearance::Affine(appearance) => appearance,
            AnyAppearance::Embed(appearance) => appearance,
            AnyAppearance::Gsw(appearance) => &**appearance,
        }
    }

    /// The look behind it, to be trained.
    pub fn as_appearance_mut(&mut self) -> &mut dyn Appearance {
        match self {
            AnyAppearance::None(appearance) => appearance,
            AnyAppearance::Affine(appearance) => appearance,
            AnyAppearance::Embed(appearance) => appearance,
            AnyAppearance::Gsw(appearance) => &mut **appearance,
        }
    }

    /// What the look makes of a view's photo before it colours splats; `draw` is given in training and differs from step
    /// to step.
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
        sight: &Sight,
        colours: Vec<f32>,
    ) -> Vec<f32> {
        match self {
            AnyAppearance::Gsw(appearance) => appearance.tint(view, light, sight, colours),
            _ => self.as_appearance().tint(view, sight.splat_embeddings, colours),
        }
    }

    /// From the gradient of [`AnyAppearance::colour`]'s result to those of its colours and codes; keeps the gradient of the
    /// look's own parameters for [`Appearance::step`]. `blame` as for [`GswAppearance::tint_backward`].
    pub fn colour_backward(
        &mut self,
        view: usize,
        light: Option<&AppearanceMaps>,
        sight: &Sight,
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
