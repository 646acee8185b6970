//! Every integration test of the crate in one program: it links once.

mod common;

mod carried;
mod knn;
mod maxflow;
mod query;
mod rivals;
mod select;
mod sgc;
