//! The tests of this crate in one executable: each further one costs a link.

mod generate;
mod sam;
mod sasm;
#[path = "../../../vision/tests/it/toy/mod.rs"]
mod toy;
