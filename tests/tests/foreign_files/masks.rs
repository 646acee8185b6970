//! Masks of other programs: what their files are called, what black and white mean in them.

use crate::Row;

pub const ROWS: &[Row] = &[];
