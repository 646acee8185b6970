//! Splats while density control acts on them: their shapes, and which splats they come from. Colours, embeddings and optimiser
//! states follow from that, on the host or on the device.

use segwild_objective::Reshaped;
use segwild_scene::Splats;

/// Shapes of splats, and which splats they come from.
pub(crate) struct Reshaping {
    /// Without colours.
    pub splats: Splats,
    /// Whether a splat's colours are finite.
    sound: Vec<bool>,
    parents: Vec<u32>,
    forgotten: Vec<bool>,
    opacities_forgotten: bool,
}

impl Reshaping {
    /// Starts with splats as they are; `sound`: per splat, whether its colours are finite.
    pub fn new(splats: Splats, sound: Vec<bool>) -> Reshaping {
        let n = splats.len();
        Reshaping {
            splats,
            sound,
            parents: (0..n as u32).collect(),
            forgotten: vec![false; n],
            opacities_forgotten: false,
        }
    }

    /// Splats there are.
    pub fn len(&self) -> usize {
        self.splats.len()
    }

    /// Whether every number of a splat is finite and its size is sane: a splat that fails is removed.
    pub fn healthy(&self, i: usize) -> bool {
        let splats = &self.splats;
        splats.means[i].iter().all(|v| v.is_finite() && v.abs() < 1e6)
            && splats.log_scales[i].iter().all(|v| v.is_finite() && *v < 12.0)
            && splats.rotations[i].iter().all(|v| v.is_finite())
            && splats.opacities[i].is_finite()
            && self.sound[i]
    }

    /// Takes the splats at `which`, in that order, with all that is known of them.
    pub fn remap(&mut self, which: &[usize]) {
        self.splats = self.splats.select(which);
        self.sound = which.iter().map(|&i| self.sound[i]).collect();
        self.parents = which.iter().map(|&i| self.parents[i]).collect();
        self.forgotten = which.iter().map(|&i| self.forgotten[i]).collect();
    }

    /// Makes the optimiser forget some splats.
    pub fn forget(&mut self, which: impl Iterator<Item = usize>) {
        which.for_each(|i| self.forgotten[i] = true);
    }

    /// Makes the optimiser forget all opacities, after a reset.
    pub fn forget_opacities(&mut self) {
        self.opacities_forgotten = true;
    }

    /// The result.
    pub fn done(self) -> Reshaped {
        let Reshaping { splats, parents, forgotten, opacities_forgotten, .. } = self;
        Reshaped { shapes: splats, parents, forgotten, opacities_forgotten }
    }
}
