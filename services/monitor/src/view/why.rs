//! Why each waiting thing waits, in words.

mod batch;
mod run;

pub(crate) use batch::{farm_scenes, scenes};
pub(crate) use run::{actors, stages};
