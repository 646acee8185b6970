//! The tests of this crate in one executable: each further one costs a link.

mod field;
mod pca;
mod support;
