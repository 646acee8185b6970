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
mod model;

pub use affine::AffineAppearance;
pub(crate) use affine::{apply_matrix, matrix_backward};
pub use bake::bake;
pub use embed::{EmbedAppearance, EmbedLight, RANK};
pub use gsw::{
    AppearanceMaps, GswAppearance, GswWidth, HIDDEN_LAYER, ImageConditioning, TrainingNetworks, UNetInput,
    VisibleSplats,
};
pub use model::{Appearance, AppearanceEmbedding, Directions};

use wincode::{SchemaRead, SchemaWrite};

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
    /// gradient of the model's own parameters for [`Appearance::step`]. `part_residuals` as for
    /// [`GswAppearance::tint_backward`].
    pub fn colour_backward(
        &mut self,
        view: usize,
        light: Option<&AppearanceMaps>,
        sight: &VisibleSplats,
        colours: &[f32],
        grad: Vec<f32>,
        part_residuals: &[Option<f32>],
    ) -> (Vec<f32>, Vec<f32>) {
        match self {
            AnyAppearance::Gsw(appearance) => {
                appearance.tint_backward(view, light, sight, colours, grad, part_residuals)
            }
            _ => self.as_appearance_mut().tint_backward(view, sight.splat_embeddings, colours, grad),
        }
    }
}
