//! Points: colours, units, outliers.

use crate::Row;

pub const ROWS: &[Row] = &[];
