//! Every integration test of the crate in one program: it links once.

mod common;

mod bench;
mod cache;
mod charts;
mod cli;
mod crowd;
mod depends;
mod deploying;
mod disk;
mod distorted;
mod kills;
mod looks;
mod operators;
mod photos;
mod received;
mod resume;
mod sam_runs;
mod skies;
mod strangers;
mod stuck;
mod traces;
