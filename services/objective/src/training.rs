//! Splats that stay on the device of an engine while they are trained.

use crate::Rule;
use crate::appearance::{EmbedLight, TrainingNetworks, UNetInput};
use crate::compare::{LossInputs, LossOutput, PhotoTarget};
use segwild_raster::{ProjectOptions, RasterError};
use segwild_scene::Splats;

/// Splats with the state of their optimiser and of density control: uploaded to a device, and downloaded from it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrainingSplats {
    /// The splats.
    pub splats: Splats,
    /// First moments of every parameter, laid out as the splats.
    pub first: Splats,
    /// Second moments likewise.
    pub second: Splats,
    /// Running sums per splat since density control acted: screen gradient, error at the centre, steps that saw it, and
    /// the largest radius as a share of the frame's long side.
    pub sums: Vec<[f32; 4]>,
    /// Per-splat appearance embeddings of [`crate::EmbedAppearance`] or [`crate::GswAppearance`], with moments; empty
    /// without either.
    pub splat_embeddings: SplatEmbeddings,
    /// The networks of [`crate::GswAppearance`].
    pub networks: Option<TrainingNetworks>,
}

/// Per-splat appearance embeddings, `[splat][embedding_size]` of their appearance model; the last
/// `EmbedAppearance::EMBEDDING_SIZE` numbers of each decay.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplatEmbeddings {
    /// The embeddings.
    pub values: Vec<f32>,
    /// Their first moments.
    pub first: Vec<f32>,
    /// And second ones.
    pub second: Vec<f32>,
}

/// Optimiser rules of one step, for each group of parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OptimiserRules {
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
    /// Of the appearance embeddings of splats in sight.
    pub splat_embeddings: Rule,
    /// Factor on these embeddings per step: they decay.
    pub kept: f32,
}

impl OptimiserRules {
    /// The same for every group; embeddings do not decay.
    pub fn all(rule: Rule) -> OptimiserRules {
        let [means, log_scales, rotations, opacities, base, higher, splat_embeddings] = [rule; 7];
        OptimiserRules { means, log_scales, rotations, opacities, base, higher, splat_embeddings, kept: 1.0 }
    }
}

/// Splats after density control: new shapes, and the parent splat that each takes everything else from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reshaped {
    /// Centres, scales, rotations and opacities; black, as [`Splats::uncoloured`] makes them.
    pub shapes: Splats,
    /// Per splat, the earlier splat whose colours, embedding and moments it takes.
    pub parents: Vec<u32>,
    /// Per splat, whether its moments start at 0.
    pub forgotten: Vec<bool>,
    /// Whether the moments of all opacities start at 0.
    pub opacities_forgotten: bool,
}

/// A step of the networks of [`crate::GswAppearance`].
#[derive(Debug)]
pub struct NetworksStep<'a> {
    /// Input of the UNet; `None`: no light is predicted in this step.
    pub unet_input: Option<UNetInput<'a>>,
    /// The step's random number, for dropout.
    pub draw: u64,
    /// Whether the visibility map may replace the robust mask.
    pub decides: bool,
    /// Optimiser rules: of the UNet, and of the other networks.
    pub rules: [Rule; 2],
}

/// Inputs of a training step.
pub struct TrainingStep<'a> {
    /// How splats are projected.
    pub options: &'a ProjectOptions,
    /// The photo's parameters ([`crate::EmbedAppearance::photo`]), for splats with appearance embeddings.
    pub light: Option<&'a EmbedLight>,
    /// The step of the networks, where there are some.
    pub networks: Option<NetworksStep<'a>>,
    /// Settings and state of the losses.
    pub loss_inputs: LossInputs<'a>,
    /// Names the photo at its size: within a process, no two targets differ under the same key.
    pub key: [u64; 3],
    /// Provides the photo; not called if the device still has it.
    pub target: &'a dyn Fn() -> PhotoTarget,
    /// The optimiser's rules.
    pub rules: &'a OptimiserRules,
}

/// Splats in training on a device: a whole step, from projection to the optimiser (method, sections 1 to 3), runs
/// there, and only the loss output is downloaded. The host gets the splats by [`DeviceTraining::download`].
pub trait DeviceTraining: Send {
    /// One step. Returns the loss output of the splats before it, and the gradient of the photo's parameters.
    ///
    /// # Panics
    /// If there is light and no embeddings, or the target is not of the camera's size.
    fn step(&mut self, step: &TrainingStep) -> Result<(LossOutput, Option<EmbedLight>), RasterError>;

    /// How many splats there are.
    fn count(&self) -> usize;

    /// The splats without colours, as [`Splats::uncoloured`] gives them, and [`TrainingSplats::sums`]: the inputs of
    /// density control.
    fn shapes(&mut self) -> Result<(Splats, Vec<[f32; 4]>), RasterError>;

    /// Applies density control; the sums restart at 0. `false` if the device lacks the memory: then nothing has
    /// changed.
    fn reshape(&mut self, reshaped: &Reshaped) -> Result<bool, RasterError>;

    /// The splats as they are now.
    fn download(&mut self) -> Result<TrainingSplats, RasterError>;
}
