//! Every integration test of the crate in one program: it links once.

mod objects;
mod protocols;
mod scenes;
mod session;
