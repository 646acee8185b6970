//! Splats that stay where an engine computes for as long as they are trained.

use crate::look::Light;
use crate::{Frame, FrameGrad, ProjectOptions, RasterError, Rule};
use segwild_scene::{Camera, Image, Pose, Splats};

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
    /// What splats keep for the look [`crate::EmbedLook`], with moments; empty without it.
    pub codes: Codes,
}

/// Codes of splats, `[splat][EmbedLook::CODE_SIZE]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Codes {
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
    pub codes: Rule,
    /// What the step leaves of these codes: they fade.
    pub kept: f32,
}

impl Rules {
    /// The same for every group, whose codes do not fade.
    pub fn all(rule: Rule) -> Rules {
        let [means, log_scales, rotations, opacities, base, higher, codes] = [rule; 7];
        Rules { means, log_scales, rotations, opacities, base, higher, codes, kept: 1.0 }
    }
}

/// Splats in training on a device: projection, colours, blending, gradients, sums for density control and the optimiser
/// (method, sections 1 and 2) run there, and what crosses is an image and its gradient. A host gets the splats when it
/// asks.
pub trait Resident: Send {
    /// Draws the splats in their own colours or, where they have codes, in the light of a photo
    /// ([`crate::EmbedLook::photo`]).
    ///
    /// # Panics
    /// If there is light and no codes.
    fn draw(
        &mut self,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
        light: Option<&Light>,
    ) -> Result<Frame, RasterError>;

    /// One step of the optimiser, by the gradients of the frame drawn last. `error`, one plane of its size, is what the
    /// sums of density control take at the centres. Returns the gradient of the light.
    ///
    /// # Panics
    /// If nothing was drawn since the last step, or the sizes differ.
    fn learn(&mut self, grad: &FrameGrad, error: &Image, rules: &Rules)
    -> Result<Option<Light>, RasterError>;

    /// The splats as they are now.
    fn fetch(&mut self) -> Result<Held, RasterError>;
}
