//! Every integration test of the crate in one program: it links once.

mod common;

mod appearances;
mod bench;
mod cache;
mod charts;
mod cli;
mod crowd;
mod cut_off;
mod demo;
mod depends;
mod deploying;
mod disk;
mod distorted;
mod elsewhere;
mod exports;
mod farm;
mod import;
mod kills;
mod objects;
mod operators;
mod page;
mod photos;
mod poses;
mod python;
mod received;
mod resume;
mod sam_runs;
mod secured;
mod service;
mod skies;
mod stuck;
mod traces;
mod transients;
mod tutorial;
