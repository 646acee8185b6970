//! Every integration test of the crate in one program: it links once.

mod wall;

mod blocks;
mod colours;
mod cut_outs;
mod exports;
mod lights;
mod perceptual;
mod poses;
mod stereo_points;
mod training;
mod transients;
