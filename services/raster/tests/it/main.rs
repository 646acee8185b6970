//! Every integration test of the crate in one program: it links once.

mod common;

mod poison;
mod properties;
mod reference;
