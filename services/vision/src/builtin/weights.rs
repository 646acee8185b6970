//! How much each trait counts at each step.
//!
//! The weights make the soft choice among all candidates as good as can be (gradient ascent on the expected IoU) over clicks on the
//! objects of two synthetic sets (seeds 1 and 2) and half of the `liberty` photos, placed as a person corrects: each in the
//! middle of the largest mistake. Other seeds and the other half do about as well.

use super::traits::{COUNT, Step};

#[rustfmt::skip]
const FIRST: [f32; COUNT] = [
    -15.73, -13.32, 21.28, -12.04, 8.378, -6.88, 16.42, 0.3791, -0.1003,
    -15.73, -13.32, 21.28, -12.04, 8.378, -6.88, 16.42, 0.3791, -0.1003,
    -0.9797, 25.94, 2.853, 0.3705, 0.0, 0.0, 9.413, 0.0, 0.0,
];

#[rustfmt::skip]
const ADD: [f32; COUNT] = [
    -4.568, -13.32, 18.22, -7.266, 15.05, 11.11, 11.7, -0.3988, 0.03097,
    0.3753, 10.07, 13.29, 8.028, -1.417, -4.808, 2.25, -0.1986, 0.003699,
    -0.01771, 8.023, 4.778, 1.336, -0.104, -7.646, 13.67, 0.0, 5.588,
];

#[rustfmt::skip]
const REMOVE: [f32; COUNT] = [
    -3.53, 7.327, 8.904, -3.077, 12.8, 13.79, 16.61, 0.003854, -0.1479,
    9.273, -2.706, 4.018, 14.25, -7.995, 7.1, 15.17, 0.2638, 0.04311,
    0.2015, 10.42, 4.66, 1.308, 0.4891, 201.4, 8.163, 0.0, 1.366,
];

#[rustfmt::skip]
const BOXED: [f32; COUNT] = [
    8.349, -7.141, 1.635, 10.23, 2.744, -0.5217, 8.96, 0.5763, -0.06043,
    8.349, -7.141, 1.635, 10.23, 2.744, -0.5217, 8.96, 0.5763, -0.06043,
    -0.7598, 14.87, 2.227, -0.5568, 0.0, 0.0, 4.711, 17.15, 3.055,
];

/// What each trait of a candidate counts, per step.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    /// For the first click.
    pub first: [f32; COUNT],
    /// For a click that adds.
    pub add: [f32; COUNT],
    /// For a click that takes away.
    pub remove: [f32; COUNT],
    /// For a box.
    pub boxed: [f32; COUNT],
}

impl Default for Weights {
    fn default() -> Weights {
        Weights { first: FIRST, add: ADD, remove: REMOVE, boxed: BOXED }
    }
}

impl Weights {
    /// Those of one step.
    pub fn of(&self, step: Step) -> &[f32; COUNT] {
        match step {
            Step::First => &self.first,
            Step::Add => &self.add,
            Step::Remove => &self.remove,
            Step::Boxed => &self.boxed,
        }
    }

    /// Those of one step, to change.
    pub fn of_mut(&mut self, step: Step) -> &mut [f32; COUNT] {
        match step {
            Step::First => &mut self.first,
            Step::Add => &mut self.add,
            Step::Remove => &mut self.remove,
            Step::Boxed => &mut self.boxed,
        }
    }
}
