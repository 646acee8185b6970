//! Every integration test of the crate in one program: it links once.

// The scenes of the rasteriser's own tests.
#[allow(dead_code)]
#[path = "../../../raster/tests/it/common/mod.rs"]
mod common;

mod fallback;
mod field;
mod loss;
mod training;
