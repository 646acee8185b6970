//! Why each waiting thing waits, in words.

mod batch;
mod run;

pub(crate) use batch::scenes;
pub(crate) use run::{actors, stages};
