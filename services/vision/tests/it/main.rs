//! The tests of this crate in one executable: each further one costs a link.

mod builtin;
mod clip;
mod networks;
mod photos;
mod sam;
mod sam2;
mod sam_files;
mod sam_folder;
mod service;
mod toy;
