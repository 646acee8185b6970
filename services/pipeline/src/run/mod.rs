//! A run: its stages, what they share, and what is decided before they start.

pub(crate) mod choice;
pub(crate) mod continued;
mod coordinator;
mod diagnostics;
pub(crate) mod explain;
pub(crate) mod graph;
mod inputs;
pub(crate) mod memory;
mod outcome;
pub(crate) mod skies;
pub(crate) mod until;
mod view_slots;
