//! Every integration test of the crate in one program: it links once.

mod coordinator;
mod dataflow;
mod simulated;
