//! What every appearance model does.

use segwild_scene::Image;
use std::ops::Range;

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
pub(super) fn through(matrix: &[f32], colours: &mut [f32]) {
    for colour in colours.chunks_exact_mut(3) {
        let [r, g, b] = [colour[0], colour[1], colour[2]];
        for c in 0..3 {
            let row = &matrix[4 * c..4 * c + 4];
            colour[c] = row[0] * r + row[1] * g + row[2] * b + row[3];
        }
    }
}
