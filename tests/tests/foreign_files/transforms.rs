//! Files of cameras as JSON: nerfstudio, Blender, instant-ngp.

use crate::Row;

pub const ROWS: &[Row] = &[];
