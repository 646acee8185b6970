//! Every integration test of the crate in one program: it links once.

mod dataflow;
mod objects;
mod pages;
mod protocols;
mod scenes;
mod session;
mod synthetic;
