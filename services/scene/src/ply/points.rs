//! Point clouds: positions and colours, in whatever form programs write them.

use super::SH0;
use super::header::ElementTable;
use crate::SceneError;
use std::path::Path;

/// A point of a point cloud.
pub(crate) struct Coloured {
    pub(crate) position: [f64; 3],
    pub(crate) colour: [u8; 3],
}

/// The colour of a point to which the file gives none.
const GREY: [u8; 3] = [128; 3];

/// Names of the three colours, the most usual first.
const COLOURS: [[&str; 3]; 6] = [
    ["red", "green", "blue"],
    ["diffuse_red", "diffuse_green", "diffuse_blue"],
    ["r", "g", "b"],
    ["R", "G", "B"],
    ["ambient_red", "ambient_green", "ambient_blue"],
    ["f_dc_0", "f_dc_1", "f_dc_2"],
];

/// Positions and colours of a point cloud; grey where the file has no colours.
///
/// Colours are bytes, 16-bit numbers or fractions, of any type: the largest value in the file tells which. Files of splats have
/// the constant harmonic instead.
pub(crate) fn read_points(path: &Path) -> Result<Vec<Coloured>, SceneError> {
    let bytes = crate::bytes::read_bytes(path).map_err(SceneError::io(path))?;
    let table = ElementTable::vertices(path, &bytes)?;
    let find = |names: [&str; 3]| match names.map(|n| table.column(n)) {
        [Some(a), Some(b), Some(c)] => Some([a, b, c]),
        _ => None,
    };
    let position = find(["x", "y", "z"])
        .ok_or_else(|| SceneError::invalid(path, "header", "there are no properties x, y, z"))?;
    let colours = COLOURS.iter().find_map(|&names| Some((find(names)?, names[0] == "f_dc_0")));
    let to_byte = colours.map(|(columns, harmonic)| to_byte(&table, columns, harmonic));
    let point = |row| {
        let value = |c: usize| table.value(row, c);
        let colour = match (colours, &to_byte) {
            (Some((columns, _)), Some(to_byte)) if columns.iter().all(|&c| value(c).is_finite()) => {
                columns.map(|c| to_byte.of(value(c)))
            }
            _ => GREY,
        };
        Coloured { position: position.map(value), colour }
    };
    Ok((0..table.len()).map(point).collect())
}

/// How values become bytes: `value * factor + offset`.
struct ToByte {
    factor: f64,
    offset: f64,
}

impl ToByte {
    fn of(&self, value: f64) -> u8 {
        (value * self.factor + self.offset).round().clamp(0.0, 255.0) as u8
    }
}

fn to_byte(table: &ElementTable, columns: [usize; 3], harmonic: bool) -> ToByte {
    if harmonic {
        return ToByte { factor: 255.0 * f64::from(SH0), offset: 127.5 };
    }
    let values = (0..table.len()).flat_map(|row| columns.map(|c| table.value(row, c)));
    let most = values.filter(|v| v.is_finite()).fold(0.0, f64::max);
    let fraction = most <= 1.0 && columns.iter().all(|&c| table.is_float(c));
    let factor = match most {
        _ if fraction => 255.0,
        most if most > 255.0 => 255.0 / 65_535.0,
        _ => 1.0,
    };
    ToByte { factor, offset: 0.0 }
}
