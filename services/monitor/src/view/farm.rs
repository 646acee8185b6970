//! A farm that is shown.

use std::fmt;
use std::sync::Arc;

use segwild_farm::JobEngine;

/// A farm that is shown.
#[derive(Clone)]
pub struct FarmTarget {
    /// Its address, for people.
    pub name: String,
    /// Its jobs.
    pub engine: Arc<dyn JobEngine>,
}

impl fmt::Debug for FarmTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "FarmTarget({})", self.name)
    }
}
