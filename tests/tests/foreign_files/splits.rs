//! Splits: which photos are for training and which for testing.

use crate::Row;

pub const ROWS: &[Row] = &[];
