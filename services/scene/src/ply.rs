//! Files of splats: INRIA's `.ply` layout in and out, antimatter15's `.splat` in.
//!
//! Written files are in the canonical layout: binary little endian, all floats, in the order `x y z nx ny nz f_dc_0..2
//! f_rest_0.. opacity scale_0..2 rot_0..3`, normals zero. Reading a canonical file and writing it again gives the same
//! bytes. Values are passed through as they are, even when they are not finite: the renderer culls those.

pub(crate) mod element;
pub(crate) mod header;
mod points;
mod values;

pub(crate) use points::{Coloured, read_points};

use crate::{SceneError, Splats, logit};
use header::ElementTable;
use segwild_files::write_atomic;
use std::path::Path;

/// Properties of one vertex without SH coefficients beyond the constant: position, normal, f_dc, opacity, scale, rot.
const FIXED: usize = 17;

/// The constant spherical harmonic, `1 / (2 sqrt(pi))`.
pub const SH0: f32 = 0.282_094_79;

/// Thickness of a two-dimensional splat, as a share of the smaller of its scales.
const FLAT: f32 = 1e-3;

/// Reads splats from a `.ply`, binary or text, its properties in any order; the SH degree follows from the number of
/// `f_rest` properties. A file whose name ends in `.splat` is read by [`read_splat`].
pub fn read(path: &Path) -> Result<Splats, SceneError> {
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("splat")) {
        return read_splat(path);
    }
    of_bytes(path, &crate::bytes::read_bytes(path).map_err(SceneError::io(path))?)
}

/// The splats of a `.ply`. Two-dimensional splats, which have two scales, get a third that is thin.
pub(crate) fn of_bytes(path: &Path, bytes: &[u8]) -> Result<Splats, SceneError> {
    let table = ElementTable::vertices(path, bytes)?;
    let column = |name: &str| {
        table.column(name).ok_or_else(|| {
            SceneError::invalid(
                path,
                "header",
                format!("there is no property `{name}`; this is no file of splats"),
            )
        })
    };
    let columns =
        |name: &str, n: usize| (0..n).map(|i| column(&format!("{name}{i}"))).collect::<Result<Vec<_>, _>>();
    let position = [column("x")?, column("y")?, column("z")?];
    // nerfstudio can write bytes of plain colours in the place of the coefficients.
    let bytes_of_colours = table.column("f_dc_0").is_none() && table.column("red").is_some();
    let constant = match bytes_of_colours {
        true => vec![column("red")?, column("green")?, column("blue")?],
        false => columns("f_dc_", 3)?,
    };
    let opacity = column("opacity")?;
    let scales = if table.column("scale_2").is_none() { 2 } else { 3 };
    let (scale, rotation) = (columns("scale_", scales)?, columns("rot_", 4)?);
    let rest_count = table.names().filter(|n| n.starts_with("f_rest_")).count();
    let sh_degree = degree_of(path, rest_count)?;
    let rest = columns("f_rest_", rest_count)?;

    let n = table.len();
    let mut splats = Splats { sh_degree, ..Splats::default() };
    // A file may have coefficients of higher degrees than are rendered: each channel starts with the lower ones.
    let (stored, bands) = (rest_count / 3, splats.sh_stride() / 3 - 1);
    for row in 0..n {
        let get = |c: usize| table.value(row, c) as f32;
        splats.means.push(position.map(get));
        splats.opacities.push(get(opacity));
        splats.log_scales.push(match scale[..] {
            [a, b, c] => [a, b, c].map(get),
            _ => {
                let [a, b] = [0, 1].map(|k| get(scale[k]));
                [a, b, a.min(b) + FLAT.ln()]
            }
        });
        splats.rotations.push([0, 1, 2, 3].map(|k| get(rotation[k])));
        let coefficient = |value: f32| if bytes_of_colours { (value / 255.0 - 0.5) / SH0 } else { value };
        splats.sh.extend(constant.iter().map(|&c| coefficient(get(c))));
        for k in 0..bands {
            splats.sh.extend((0..3).map(|c| get(rest[c * stored + k])));
        }
    }
    Ok(splats)
}

/// The degree of colours with so many coefficients beyond the constant, in all channels; 3 for those of degree 4, of which the
/// lower ones are read.
pub(crate) fn degree_of(path: &Path, coefficients: usize) -> Result<u32, SceneError> {
    let degree = (0..=4u32).find(|d| 3 * ((d + 1).pow(2) - 1) as usize == coefficients);
    degree.map(|degree| degree.min(3)).ok_or_else(|| {
        let reason = format!(
            "{coefficients} f_rest properties are no whole SH degree up to 4 (0, 9, 24, 45 or 72 are)"
        );
        SceneError::invalid(path, "header", reason)
    })
}

/// Reads one more property per splat as bytes, such as a label; `None` when the file has no such property.
pub fn read_extra(path: &Path, name: &str) -> Result<Option<Vec<u8>>, SceneError> {
    let bytes = crate::bytes::read_bytes(path).map_err(SceneError::io(path))?;
    let table = ElementTable::vertices(path, &bytes)?;
    Ok(table.column(name).map(|c| (0..table.len()).map(|row| table.value(row, c) as u8).collect()))
}

/// Writes splats in the canonical layout.
pub fn write(path: &Path, splats: &Splats) -> Result<(), SceneError> {
    write_with(path, splats, &[])
}

/// Writes splats in the canonical layout with more properties at the end of each vertex: a name and one byte per
/// splat. Other programs pass over properties they do not know.
///
/// # Panics
/// When an array of `splats` or an extra one has another length than there are splats.
pub fn write_with(path: &Path, splats: &Splats, extra: &[(&str, &[u8])]) -> Result<(), SceneError> {
    Ok(write_atomic(path, &to_bytes(splats, extra, &[]))?)
}

/// The bytes of the file, with comments in the header, each without line ends.
pub(crate) fn to_bytes(splats: &Splats, extra: &[(&str, &[u8])], comments: &[String]) -> Vec<u8> {
    let n = splats.len();
    let stride = splats.sh_stride();
    assert!(
        splats.log_scales.len() == n
            && splats.rotations.len() == n
            && splats.opacities.len() == n
            && splats.sh.len() == n * stride
            && extra.iter().all(|(_, values)| values.len() == n),
        "arrays of different lengths"
    );
    let bands = stride / 3 - 1;
    let comments: String = comments.iter().map(|comment| format!("comment {comment}\n")).collect();
    let mut header = format!("ply\nformat binary_little_endian 1.0\n{comments}element vertex {n}\n");
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into_iter();
    let names = names.chain((0..3 * bands).map(|k| format!("f_rest_{k}")));
    let tail =
        ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(String::from);
    for name in names.chain(tail) {
        header += &format!("property float {name}\n");
    }
    for (name, _) in extra {
        header += &format!("property uchar {name}\n");
    }
    header += "end_header\n";

    let mut out = header.into_bytes();
    out.reserve(n * (4 * (FIXED + 3 * bands) + extra.len()));
    for i in 0..n {
        let mut put = |values: &[f32]| values.iter().for_each(|v| out.extend(v.to_le_bytes()));
        put(&splats.means[i]);
        put(&[0.0; 3]);
        let sh = &splats.sh[i * stride..(i + 1) * stride];
        put(&sh[..3]);
        for c in 0..3 {
            for k in 1..=bands {
                put(&[sh[3 * k + c]]);
            }
        }
        put(&[splats.opacities[i]]);
        put(&splats.log_scales[i]);
        put(&splats.rotations[i]);
        out.extend(extra.iter().map(|(_, values)| values[i]));
    }
    out
}

/// Reads antimatter15's `.splat`: 32 bytes per splat, position and standard deviations as floats, colour with
/// opacity and rotation (w, x, y, z) as bytes.
pub fn read_splat(path: &Path) -> Result<Splats, SceneError> {
    splat_of_bytes(path, &crate::bytes::read_bytes(path).map_err(SceneError::io(path))?)
}

/// The splats of a `.splat`.
pub(crate) fn splat_of_bytes(path: &Path, bytes: &[u8]) -> Result<Splats, SceneError> {
    const RECORD: usize = 32;
    let (n, over) = (bytes.len() / RECORD, bytes.len() % RECORD);
    if over != 0 {
        return Err(SceneError::Truncated {
            path: path.to_owned(),
            record: format!("splat {}", n + 1),
            offset: (n * RECORD) as u64,
            needed: RECORD as u64,
            left: over as u64,
        });
    }
    let mut splats = Splats::default();
    for record in bytes.chunks_exact(RECORD) {
        let float = |k: usize| f32::from_le_bytes([record[k], record[k + 1], record[k + 2], record[k + 3]]);
        splats.means.push([float(0), float(4), float(8)]);
        // A deviation of 0 would be the logarithm of nothing; e^-30 is nothing enough.
        splats.log_scales.push([12, 16, 20].map(|k| float(k).max(0.0).ln().max(-30.0)));
        splats.sh.extend([24, 25, 26].map(|k| (f32::from(record[k]) / 255.0 - 0.5) / SH0));
        // Half a step in from the ends keeps the logit finite.
        let opacity = f32::from(record[27]).clamp(0.5, 254.5) / 255.0;
        splats.opacities.push(logit(opacity));
        splats.rotations.push([28, 29, 30, 31].map(|k| (f32::from(record[k]) - 128.0) / 128.0));
    }
    Ok(splats)
}
