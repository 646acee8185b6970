//! Splats that stay where an engine computes for as long as they are trained.

use crate::appearance::{HeldNetworks, Light, UNetInput};
use crate::compare::{LossInputs, LossOutput, Target};
use crate::{ProjectOptions, RasterError, Rule};
use segwild_scene::Splats;

/// Splats, and what their optimiser and density control know of them: what goes to a device and comes back.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Held {
    /// The splats.
    pub splats: Splats,
    /// First moments of every parameter, laid out as the splats.
    pub first: Splats,
    /// Second moments likewise.
    pub second: Splats,
    /// Running sums per splat since density control acted: screen gradient, error at the centre, steps that saw it, and
    /// the largest radius as a share of the frame's long side.
    pub sums: Vec<[f32; 4]>,
    /// What splats keep for the look [`crate::EmbedAppearance`], or [`crate::GswAppearance`], with moments; empty without either.
    pub splat_embeddings: SplatEmbeddings,
    /// The networks of the look [`crate::GswAppearance`].
    pub networks: Option<HeldNetworks>,
}

/// Codes of splats, `[splat][embedding_size]` of their look; the last `EmbedAppearance::EMBEDDING_SIZE` of each fade.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplatEmbeddings {
    /// The codes.
    pub values: Vec<f32>,
    /// Their first moments.
    pub first: Vec<f32>,
    /// And second ones.
    pub second: Vec<f32>,
}

/// How far one step goes, for each group of parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rules {
    /// Of the centres.
    pub means: Rule,
    /// Of the log scales.
    pub log_scales: Rule,
    /// Of the rotations.
    pub rotations: Rule,
    /// Of the opacities.
    pub opacities: Rule,
    /// Of the colours' constant part.
    pub base: Rule,
    /// Of the colours' higher degrees.
    pub higher: Rule,
    /// Of the codes, of splats in sight.
    pub splat_embeddings: Rule,
    /// What the step leaves of these codes: they fade.
    pub kept: f32,
}

impl Rules {
    /// The same for every group, whose codes do not fade.
    pub fn all(rule: Rule) -> Rules {
        let [means, log_scales, rotations, opacities, base, higher, splat_embeddings] = [rule; 7];
        Rules { means, log_scales, rotations, opacities, base, higher, splat_embeddings, kept: 1.0 }
    }
}

/// Splats as density control left them: new shapes, and of which splat before each has everything else.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reshaped {
    /// Centres, scales, rotations and opacities; black, as [`Splats::uncoloured`] makes them.
    pub shapes: Splats,
    /// Per splat, the one before whose colours, code and moments it takes.
    pub parents: Vec<u32>,
    /// Per splat, whether the optimiser knows nothing of it.
    pub forgotten: Vec<bool>,
    /// Whether the optimiser knows nothing of any opacity.
    pub opacities_forgotten: bool,
}

/// A step of the networks of the look [`crate::GswAppearance`].
#[derive(Debug)]
pub struct NetworksStep<'a> {
    /// What the network of the photo is given; `None`: no light is read.
    pub unet_input: Option<UNetInput<'a>>,
    /// What the step draws.
    pub draw: u64,
    /// Whether what the network sees of the photo may take the robust mask's place.
    pub decides: bool,
    /// How far the optimiser goes: of the photo's network, and of the others.
    pub rules: [Rule; 2],
}

/// What a step of training looks at.
pub struct Step<'a> {
    /// How splats are projected.
    pub options: &'a ProjectOptions,
    /// The photo's light ([`crate::EmbedAppearance::photo`]), upon splats that have codes.
    pub light: Option<&'a Light>,
    /// What the networks do, where there are some.
    pub networks: Option<NetworksStep<'a>>,
    /// Under what the photo is compared.
    pub loss_inputs: LossInputs<'a>,
    /// Names the photo at its size: within a process, no two targets differ under the same key.
    pub key: [u64; 3],
    /// The photo; not asked for if it is still there.
    pub target: &'a dyn Fn() -> Target,
    /// How far the optimiser goes.
    pub rules: &'a Rules,
}

/// Splats in training on a device: a whole step, from projection to the optimiser (method, sections 1 to 3), runs there,
/// and what crosses is what the photo said. A host gets the splats when it asks.
pub trait Resident: Send {
    /// One step: what the photo said of the splats as they were before it, and the gradient of the light.
    ///
    /// # Panics
    /// If there is light and no codes, or the target is not of the camera's size.
    fn step(&mut self, step: &Step) -> Result<(LossOutput, Option<Light>), RasterError>;

    /// How many splats there are.
    fn count(&self) -> usize;

    /// The splats without colours, as [`Splats::uncoloured`] gives them, and [`Held::sums`]: what density control asks for.
    fn shapes(&mut self) -> Result<(Splats, Vec<[f32; 4]>), RasterError>;

    /// Takes them as density control left them; sums begin anew. `false` if there is no room for them: then nothing has
    /// changed.
    fn reshape(&mut self, reshaped: &Reshaped) -> Result<bool, RasterError>;

    /// The splats as they are now.
    fn fetch(&mut self) -> Result<Held, RasterError>;
}
