//! Splats while density control acts on them: their shapes, and which splats they come from. Colours, embeddings and optimiser
//! states follow from that, on the host or on the device.

use glam::Vec3;
use segwild_objective::Reshaped;
use segwild_scene::{Splats, logit};

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

/// Replaces splats by two halves each, along their longest axis; the second halves go to the end.
///
/// A Gaussian of deviation s becomes two at +-d with deviation s' such that d^2 + s'^2 = s^2; the other axes
/// shrink a little and the opacity falls, so that the image hardly changes. The optimiser forgets both: its
/// first steps on new splats are then its longest, which is what puts them to use in short runs.
pub(crate) fn split_in_two(all: &mut Reshaping, which: &[usize]) {
    const OFFSET: f32 = 0.7;
    const SHRINK: f32 = 0.714;
    const NARROW: f32 = 0.85;
    let n = all.len();
    let parents: Vec<usize> = (0..n).chain(which.iter().copied()).collect();
    all.remap(&parents);
    all.forget((n..parents.len()).chain(which.iter().copied()));
    let splats = &mut all.splats;
    for (k, &i) in which.iter().enumerate() {
        let scale = splats.scale(i);
        let axis = (0..3).max_by(|&a, &b| scale[a].total_cmp(&scale[b])).expect("three axes");
        let direction: Vec3 = splats.rotation(i).col(axis) * scale[axis] * OFFSET;
        let lowered = logit((1.0 - (1.0 - splats.opacity(i)).powf(0.7)).clamp(0.004, 0.995));
        for (j, sign) in [(i, 1.0), (n + k, -1.0)] {
            for a in 0..3 {
                splats.means[j][a] += sign * direction[a];
                splats.log_scales[j][a] += if a == axis { SHRINK.ln() } else { NARROW.ln() };
            }
            splats.opacities[j] = lowered;
        }
    }
}
