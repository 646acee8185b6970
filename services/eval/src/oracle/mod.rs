//! Providers that know the truth of a synthetic set, with faults of a chosen size: what a perfect, or a known
//! imperfect, 2D model would let the rest of the program reach (method, section 11).
//!
//! An image is known by its content: exactly, when it is a photo or a clean view of the set, and otherwise (a
//! render, a scaled photo) by likeness.

mod embed;
mod masks;
mod options;
mod truth;

pub use options::{ORACLE, OracleOptions};
pub use truth::Oracle;
