//! Every integration test of the crate in one program: it links once.

mod common;

mod formats;
mod imports;
mod open;
mod photo_store;
mod photos;
mod shapes;
mod shared_data;
mod view_selection;
