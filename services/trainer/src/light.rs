//! The light that a trained scene is rendered in: a photo's appearance, an interpolation of several, or two at once.

use crate::TrainError;
use crate::model::Model;
use glam::Vec3;
use segwild_objective::background::{Background, add_background};
use segwild_objective::{AnyAppearance, AppearanceEmbedding, bake};
use segwild_raster::{Channels, Projected, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Splats};

/// An appearance taken out of the model: the appearance embedding that changes the splats' colours, and its background in its own
/// colours.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneLight {
    appearance_embedding: AppearanceEmbedding,
    background: Background,
}

impl SceneLight {
    /// A light of an appearance embedding, and of a background in its own colours.
    pub(crate) fn new(appearance_embedding: AppearanceEmbedding, background: Background) -> SceneLight {
        SceneLight { appearance_embedding, background }
    }

    /// The light a share `t` of the way to another: 0 is this one, 1 the other, and past 1 it goes on beyond it.
    pub fn towards(&self, other: &SceneLight, t: f32) -> SceneLight {
        SceneLight {
            appearance_embedding: self.appearance_embedding.towards(&other.appearance_embedding, t),
            background: self.background.towards(&other.background, t),
        }
    }

    /// The background in this light.
    pub fn background(&self) -> &Background {
        &self.background
    }
}

/// How a scene is lit.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneLighting {
    /// The light of the scene and of its background.
    pub scene: SceneLight,
    /// Other lights for some splats: per splat whether it has it. Of several, the last counts.
    pub objects: Vec<(Vec<bool>, SceneLight)>,
}

impl From<SceneLight> for SceneLighting {
    fn from(scene: SceneLight) -> SceneLighting {
        SceneLighting { scene, objects: Vec::new() }
    }
}

impl Model {
    /// The light of a view's photo; the mean one where the photo took no part or none is named.
    pub fn light(&self, view: Option<usize>) -> SceneLight {
        let appearance_embedding = self.appearance.as_appearance().appearance_embedding(
            self.appearance_index(view),
            &self.splats.means,
            &self.splat_embeddings,
        );
        SceneLight { appearance_embedding, background: self.background(view) }
    }

    /// A light with another strength: 0 is the mean light, 1 the light as it is, 2 twice as far from the mean.
    pub fn strengthened(&self, light: &SceneLight, strength: f32) -> SceneLight {
        if strength == 1.0 { light.clone() } else { self.light(None).towards(light, strength) }
    }

    /// The splats' colours under a lighting, from their own colours towards a camera.
    fn lit(&self, lighting: &SceneLighting, pose: &Pose, projected: &dyn Projected) -> Vec<f32> {
        let colours = projected.shade();
        let direction = directions(&self.splats, pose.centre(), projected.radii());
        let under = |light: &SceneLight, colours| {
            self.appearance.as_appearance().shade(
                &light.appearance_embedding,
                &self.splat_embeddings,
                &direction,
                colours,
            )
        };
        let mut all = match lighting.objects.is_empty() {
            true => return under(&lighting.scene, colours),
            false => under(&lighting.scene, colours.clone()),
        };
        for (whose, light) in &lighting.objects {
            mix(&mut all, &under(light, colours.clone()), whose, 3);
        }
        all
    }

    /// Whether any appearance changes the splats' colours.
    pub fn changes_colours(&self) -> bool {
        !matches!(self.appearance, AnyAppearance::None(_))
    }

    /// The splats with a lighting's colours as their own, for programs without appearance models. See
    /// [`segwild_objective::bake`].
    ///
    /// # Panics
    /// If the lighting is of another model.
    pub fn baked(&self, lighting: &SceneLighting) -> Splats {
        let under = |light: &SceneLight| {
            bake(
                self.appearance.as_appearance(),
                &light.appearance_embedding,
                &self.splats,
                &self.splat_embeddings,
            )
        };
        let mut all = under(&lighting.scene);
        for (whose, light) in &lighting.objects {
            let stride = all.sh_stride();
            mix(&mut all.sh, &under(light).sh, whose, stride);
        }
        all
    }
}

/// The directions from an eye to the splats that it sees, which are those with a radius.
pub(crate) fn directions<'a>(
    splats: &'a Splats,
    eye: Vec3,
    radii: &'a [f32],
) -> impl Fn(usize) -> Option<[f32; 3]> + Sync + 'a {
    move |i| (radii[i] > 0.0).then(|| (splats.mean(i) - eye).normalize_or_zero().to_array())
}

/// Takes the other's numbers for the splats that are marked.
fn mix(all: &mut [f32], other: &[f32], whose: &[bool], stride: usize) {
    assert_eq!(all.len(), whose.len() * stride, "a mark per splat");
    for ((to, from), _) in
        all.chunks_exact_mut(stride).zip(other.chunks_exact(stride)).zip(whose).filter(|(_, marked)| **marked)
    {
        to.copy_from_slice(from);
    }
}

/// The scene from a camera under a lighting, over its background; sRGB in [0, 1].
pub fn render_lit(
    model: &Model,
    engine: &dyn Rasterizer,
    camera: &Camera,
    pose: &Pose,
    lighting: &SceneLighting,
) -> Result<Image, TrainError> {
    let projected = engine.project(&model.splats, camera, pose, &model.options())?;
    let colours = model.lit(lighting, pose, &*projected);
    let frame = projected.blend(&Channels { count: 3, values: &colours })?;
    let mut image = frame.image;
    add_background(&mut image, &frame.alpha, &lighting.scene.background.paint(camera, pose));
    image.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    Ok(image)
}
