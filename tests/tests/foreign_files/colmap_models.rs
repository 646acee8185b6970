//! COLMAP reconstructions: where they lie, what their cameras are, how their names are written.

use crate::Row;

pub const ROWS: &[Row] = &[];
