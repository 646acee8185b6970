//! The stage or step at which a run stops.

use super::stage::Stage;
use crate::artifacts::keys::End;
use std::fmt;
use std::str::FromStr;

/// The last thing a run does: a stage, or a step of the training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Until {
    /// This stage, one of [`Stage::all_listed`], and what it needs.
    Stage(Stage),
    /// This step of the training. Fewer than the settings' `steps` leaves the training to be continued; more continues
    /// past the end of its schedules, at their last rates.
    Step(u32),
}

impl Until {
    /// Where the training of a run that is to stop at `until` ends.
    pub(crate) fn end(until: Option<Until>) -> End {
        match until {
            Some(Until::Step(step)) => End::Step(step),
            _ => End::Settings,
        }
    }

    /// A stage by name.
    pub fn stage(name: &str) -> Option<Until> {
        Stage::named(name).map(Until::Stage)
    }
}

/// Why a text names nothing at which a run can stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UntilError {
    /// It is step 0.
    #[error("there is no step 0: give 1 or more")]
    StepZero,
    /// It is neither the name of a stage nor a number.
    #[error(
        "neither a stage ({}) nor a number of training steps",
        Stage::all_listed().map(Stage::name).collect::<Vec<_>>().join(", ")
    )]
    Unknown,
}

impl FromStr for Until {
    type Err = UntilError;

    fn from_str(text: &str) -> Result<Until, UntilError> {
        match text.parse::<u32>() {
            Ok(0) => Err(UntilError::StepZero),
            Ok(step) => Ok(Until::Step(step)),
            Err(_) => Until::stage(text).ok_or(UntilError::Unknown),
        }
    }
}

impl fmt::Display for Until {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Until::Stage(stage) => f.write_str(stage.name()),
            Until::Step(step) => write!(f, "step {step}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_or_a_step() {
        assert_eq!("geometry".parse(), Ok(Until::Stage(Stage::Geometry)));
        assert_eq!("500".parse(), Ok(Until::Step(500)));
        for wrong in ["0", "-3", "geometri", ""] {
            let message = wrong.parse::<Until>().unwrap_err().to_string();
            assert!(message.contains("step"), "{message}");
        }
    }
}
