//! Weights of the traits, per kind of prompt.
//!
//! `examples/train_prompts` learns them: gradient ascent on the expected IoU of the soft choice among all interpretations of a
//! prompt, over prompts made as a person makes them. The commands are in docs/experiments/2026-11-21-prompts-in-one-photo.md.

use super::traits::{COUNT, PromptStep};

/// Weight of each trait of a candidate, per kind of prompt.
#[derive(Clone, Debug, PartialEq)]
pub struct TraitWeights {
    /// For the first click.
    pub first: [f32; COUNT],
    /// For a click that adds.
    pub add: [f32; COUNT],
    /// For a click that removes.
    pub remove: [f32; COUNT],
    /// For a box.
    pub boxed: [f32; COUNT],
}

/// With the built-in boundaries.
#[rustfmt::skip]
const BUILTIN: TraitWeights = TraitWeights {
    first: [
        0.0856, -40.91, 24.39, -19.13, 9.599, -9.234, 27.44, -1.265, -0.2381,
        0.0856, -40.91, 24.39, -19.13, 9.599, -9.234, 27.44, -1.265, -0.2381,
        -7.083, 18.86, 3.437, -0.6858, 0.0, 0.0, 2.355, 0.0, 0.0,
    ],
    add: [
    -4.568, -13.32, 18.22, -7.266, 15.05, 11.11, 11.7, -0.3988, 0.03097,
    0.3753, 10.07, 13.29, 8.028, -1.417, -4.808, 2.25, -0.1986, 0.003699,
    -0.01771, 8.023, 4.778, 1.336, -0.104, -7.646, 13.67, 0.0, 5.588,
    ],
    remove: [
    -3.53, 7.327, 8.904, -3.077, 12.8, 13.79, 16.61, 0.003854, -0.1479,
    9.273, -2.706, 4.018, 14.25, -7.995, 7.1, 15.17, 0.2638, 0.04311,
    0.2015, 10.42, 4.66, 1.308, 0.4891, 201.4, 8.163, 0.0, 1.366,
    ],
    boxed: [
        13.55, -11.64, 0.4397, 7.973, 4.015, 1.608, 10.02, 0.6039, -0.0649,
        13.55, -11.64, 0.4397, 7.973, 4.015, 1.608, 10.02, 0.6039, -0.0649,
        -0.0474, 3.413, 4.426, -1.971, 0.0, 0.0, -1.281, 28.64, 3.897,
    ],
};

/// With those of the edge network.
#[rustfmt::skip]
const NETWORK: TraitWeights = TraitWeights {
    first: [
        20.09, 11.38, 16.36, -19.93, 3.236, -6.045, 14.83, -1.706, -0.2307,
        20.09, 11.38, 16.36, -19.93, 3.236, -6.045, 14.83, -1.706, -0.2307,
        -2.843, 23.34, 2.989, -2.603, 0.0, 0.0, 5.474, 0.0, 0.0,
    ],
    add: [
        20.18, 14.35, 20.95, -6.723, 7.043, 12.31, -6.692, -0.5558, -0.0264,
        4.628, 2.824, -1.297, -0.8605, 0.5129, -8.635, 0.0573, -0.4489, 0.0996,
        -0.6496, 15.98, 6.465, 2.701, -0.258, -21.16, 24.42, 0.0, -3.192,
    ],
    remove: [
        15.37, -1.068, 13.65, -17.93, 12.6, 11.62, 27.88, 0.6102, -0.1979,
        5.074, 0.0199, 4.117, 8.794, -2.337, 1.93, 9.712, 0.1019, 0.0337,
        0.0077, 12.66, 4.213, 0.6688, 0.0759, -1.713, 1.471, 0.0, 1.901,
    ],
    boxed: [
        12.55, -8.692, 0.1693, 19.87, 2.489, 0.866, -13.8, 0.5149, -0.0521,
        12.55, -8.692, 0.1693, 19.87, 2.489, 0.866, -13.8, 0.5149, -0.0521,
        3.011, 9.319, 1.022, 0.3479, 0.0, 0.0, 21.51, 24.76, 4.421,
    ],
};

impl TraitWeights {
    /// Those learned with the built-in boundaries.
    pub const fn builtin() -> TraitWeights {
        BUILTIN
    }

    /// Those learned with the boundaries of the edge network.
    pub const fn network() -> TraitWeights {
        NETWORK
    }

    /// Those of one step.
    pub fn of(&self, step: PromptStep) -> &[f32; COUNT] {
        match step {
            PromptStep::First => &self.first,
            PromptStep::Add => &self.add,
            PromptStep::Remove => &self.remove,
            PromptStep::Boxed => &self.boxed,
        }
    }

    /// Those of one step, to change.
    pub fn of_mut(&mut self, step: PromptStep) -> &mut [f32; COUNT] {
        match step {
            PromptStep::First => &mut self.first,
            PromptStep::Add => &mut self.add,
            PromptStep::Remove => &mut self.remove,
            PromptStep::Boxed => &mut self.boxed,
        }
    }
}
