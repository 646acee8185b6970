//! Every integration test of the crate in one program: it links once.

mod common;

mod baselines;
mod boxes;
mod carried;
mod idle;
mod knn;
mod many_photos;
mod masked_tree;
mod maxflow;
mod query;
mod scene_tree;
mod select;
mod sgc;
mod surfaces;
