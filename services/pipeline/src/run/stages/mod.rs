//! The stages of a run, a file each: what the stage needs, how it starts, and what follows from the outcomes of its
//! actor. A new stage is a file here, a line in [`Stage`](super::stage::Stage), and its lines in this file.

mod embed;
mod evaluate;
mod features;
mod geometry;
mod masks;
mod objects;
mod poses;
mod report;
mod sky;
mod visibility;

use super::node::StageNode;

/// Every stage, in the order in which they end.
pub static NODES: &[StageNode] = &[
    poses::NODE,
    sky::NODE,
    embed::NODE,
    masks::NODE,
    geometry::NODE,
    visibility::NODE,
    features::NODE,
    evaluate::NODE,
    objects::NODE,
    report::NODE,
];
