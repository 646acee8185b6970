//! Every integration test of the crate in one program: it links once.

mod wall;

mod between;
mod colours;
mod cut_outs;
mod exports;
mod lights;
mod strangers;
mod training;
