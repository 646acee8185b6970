//! Every integration test of the crate in one program: it links once.

mod common;

mod batch;
mod connections;
mod metrics;
mod view;
