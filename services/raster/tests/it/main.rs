//! Every integration test of the crate in one program: it links once.

mod common;

mod fallback;
mod field;
mod loss;
mod poison;
mod properties;
mod reference;
mod training;
