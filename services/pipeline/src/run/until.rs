//! The stage or step at which a run stops.

use crate::run::graph::STAGES;
use std::fmt;
use std::str::FromStr;

/// The last thing a run does: a stage, or a step of the training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Until {
    /// This stage of [`STAGES`], and what it needs.
    Stage(&'static str),
    /// This step of the training. Fewer than the settings' `steps` leaves the training to be continued; more continues
    /// past the end of its schedules, at their last rates.
    Step(u32),
}

impl Until {
    /// A stage by name.
    pub fn stage(name: &str) -> Option<Until> {
        STAGES.into_iter().find(|s| *s == name).map(Until::Stage)
    }
}

impl FromStr for Until {
    type Err = String;

    fn from_str(text: &str) -> Result<Until, String> {
        match text.parse::<u32>() {
            Ok(0) => Err("there is no step 0: give 1 or more".into()),
            Ok(step) => Ok(Until::Step(step)),
            Err(_) => Until::stage(text).ok_or_else(|| {
                format!("neither a stage ({}) nor a number of training steps", STAGES.join(", "))
            }),
        }
    }
}

impl fmt::Display for Until {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Until::Stage(stage) => f.write_str(stage),
            Until::Step(step) => write!(f, "step {step}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_or_a_step() {
        assert_eq!("geometry".parse(), Ok(Until::Stage("geometry")));
        assert_eq!("500".parse(), Ok(Until::Step(500)));
        for wrong in ["0", "-3", "geometri", ""] {
            let message = wrong.parse::<Until>().unwrap_err();
            assert!(message.contains("step"), "{message}");
        }
    }
}
