//! Stresses: what is done to a scene, to the providers or to the clicks, and how much of it.

use crate::point::{PhotoSource, PointJob, Prompting};
use segwild_synthetic::SyntheticOptions;

/// The protocol under which everything here is recorded.
pub const PROTOCOL: &str = "stability";

/// One kind of stress and how much of it.
#[derive(Clone, Copy)]
pub struct Stress {
    /// Its name.
    pub name: &'static str,
    /// What is done.
    pub meaning: &'static str,
    /// What the amounts are, on an axis.
    pub axis: &'static str,
    /// The amounts.
    pub values: &'static [f64],
    /// Whether the axis grows by factors.
    pub log: bool,
    /// The amount with which others are compared: none of the stress, or the default.
    pub calm: f64,
    /// Puts an amount into a job.
    pub apply: fn(&mut PointJob, f64),
}

/// The stresses that are faults of the oracle: no other provider can simulate them.
const OF_THE_ORACLE: [&str; 4] =
    ["missing masks", "merged masks", "wandering boundaries", "noisy descriptors"];

impl Stress {
    /// Whether it is a fault of the oracle, which no other provider can simulate.
    pub fn is_of_the_oracle(&self) -> bool {
        OF_THE_ORACLE.contains(&self.name)
    }
}

fn scene(job: &mut PointJob, change: impl Fn(&mut SyntheticOptions)) {
    if let PhotoSource::Synthetic(options) = &mut job.source {
        change(options);
    }
}

fn set(job: &mut PointJob, name: &str, value: impl ToString) {
    job.settings.push((name.into(), value.to_string()));
}

/// The stresses, in the order of the page.
pub const STRESSES: &[Stress] = &[
    Stress {
        name: "occluders",
        meaning: "transients cover this share of every photo",
        axis: "share covered",
        values: &[0.0, 0.1, 0.25, 0.4, 0.5, 0.6],
        log: false,
        calm: 0.0,
        apply: |job, v| scene(job, |s| s.occlusion = v as f32),
    },
    Stress {
        name: "light",
        meaning: "appearances differ from photo to photo by so many times the usual range",
        axis: "strength of the appearances",
        values: &[0.0, 0.5, 1.0, 1.5, 2.0],
        log: false,
        calm: 0.0,
        apply: |job, v| scene(job, |s| s.appearance_strength = v as f32),
    },
    Stress {
        name: "photos",
        meaning: "photos trained on",
        axis: "photos",
        values: &[40.0, 20.0, 12.0, 8.0, 5.0, 3.0],
        log: true,
        calm: 40.0,
        apply: |job, v| scene(job, |s| s.train = v as usize),
    },
    Stress {
        name: "turned cameras",
        meaning: "every pose is turned by so many degrees about a random axis (standard deviation)",
        axis: "degrees",
        values: &[0.0, 0.1, 0.3, 1.0, 3.0],
        log: false,
        calm: 0.0,
        apply: |job, v| job.harm.turn = v,
    },
    Stress {
        name: "moved cameras",
        meaning: "every pose is moved by this share of the cameras' distance (standard deviation)",
        axis: "share of the distance",
        values: &[0.0, 0.003, 0.01, 0.03, 0.1],
        log: false,
        calm: 0.0,
        apply: |job, v| job.harm.shift = v,
    },
    Stress {
        name: "false points",
        meaning: "share of the reconstructed points that lie anywhere",
        axis: "share of outliers",
        values: &[0.0, 0.02, 0.2, 0.5, 0.9],
        log: false,
        calm: 0.0,
        apply: |job, v| scene(job, |s| s.outliers = v as f32),
    },
    Stress {
        name: "copies",
        meaning: "different photos; all others are copies of these under other poses",
        axis: "different photos",
        values: &[20.0, 10.0, 4.0, 1.0],
        log: true,
        calm: 20.0,
        apply: |job, v| job.harm.copies = if v >= 20.0 { 0 } else { v as usize },
    },
    Stress {
        name: "units",
        meaning: "the same scene in other units",
        axis: "file units per unit",
        values: &[1e-3, 1.0, 1e3],
        log: true,
        calm: 1.0,
        apply: |job, v| scene(job, |s| s.units = v),
    },
    Stress {
        name: "far from the origin",
        meaning: "the scene lies so many times its size away from the file's origin, as in map coordinates",
        axis: "sizes away",
        values: &[0.0, 1e3, 1e6],
        log: false,
        calm: 0.0,
        apply: |job, v| job.harm.offset = v,
    },
    Stress {
        name: "missing masks",
        meaning: "share of the masks that the provider does not give",
        axis: "share missing",
        values: &[0.0, 0.1, 0.3, 0.6, 0.9],
        log: false,
        calm: 0.0,
        apply: |job, v| job.faults.drop = v as f32,
    },
    Stress {
        name: "merged masks",
        meaning: "share of the masks that run into a neighbour",
        axis: "share merged",
        values: &[0.0, 0.05, 0.3, 0.6, 0.9],
        log: false,
        calm: 0.0,
        apply: |job, v| job.faults.merge = v as f32,
    },
    Stress {
        name: "wandering boundaries",
        meaning: "masks whose boundaries are off by up to so many pixels, of 160",
        axis: "pixels",
        values: &[0.0, 3.0, 6.0, 12.0, 24.0],
        log: false,
        calm: 0.0,
        apply: |job, v| job.faults.wobble = v as f32,
    },
    Stress {
        name: "noisy descriptors",
        meaning: "noise on each cell of the embedding, beside descriptors of length 1",
        axis: "length of the noise",
        values: &[0.0, 0.25, 1.0, 2.0, 4.0],
        log: false,
        calm: 0.0,
        apply: |job, v| job.faults.noise = v as f32,
    },
    Stress {
        name: "click beside the middle",
        meaning: "the click lies so many pixels, of 160, from where it was meant",
        axis: "pixels",
        values: &[0.0, 2.0, 4.0, 8.0, 16.0],
        log: false,
        calm: 0.0,
        apply: |job, v| job.prompting = Prompting::Beside(v as f32),
    },
    Stress {
        name: "click near the border",
        meaning: "the click lies so many pixels inside the object's outline",
        axis: "pixels inside",
        values: &[8.0, 4.0, 2.0, 1.0],
        log: false,
        calm: 8.0,
        apply: |job, v| job.prompting = Prompting::Inside(v as f32),
    },
    Stress {
        name: "random clicks",
        meaning: "ten clicks anywhere on each object, in any photo that shows it",
        axis: "clicks",
        values: &[10.0],
        log: false,
        calm: 10.0,
        apply: |job, v| job.prompting = Prompting::Random(v as u32),
    },
    Stress {
        name: "tau",
        meaning: "resemblance from which a splat may belong to the object, required of every splat as in the paper",
        axis: "tau",
        values: &[0.1, 0.3, 0.5, 0.7, 0.9],
        log: false,
        calm: 0.5,
        apply: |job, v| {
            set(job, "similarity_use", "gate");
            set(job, "tau", v);
        },
    },
];
