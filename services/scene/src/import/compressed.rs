//! `.compressed.ply` of PlayCanvas and SuperSplat: four 32-bit numbers per splat, in chunks of 256 whose bounds stand before
//! them (github.com/playcanvas/splat-transform, `decompressPly`).

use super::quantised::{stored_logit, with_largest};
use crate::ply::SH0;
use crate::ply::header::{ElementTable, Header};
use crate::{SceneError, Splats};
use std::path::Path;

/// Splats of a chunk.
const CHUNK: usize = 256;
/// Range of the colour coefficients: -4 to 4.
const COEFFICIENTS: f32 = 8.0;

/// Whether a header is that of such a file.
pub(super) fn is_compressed(header: &Header) -> bool {
    let packed = |vertex: &crate::ply::element::Element| vertex.has("packed_position");
    header.element("chunk").is_some() && header.element("vertex").is_some_and(packed)
}

/// The degree of its colours, by the coefficients that it declares.
pub(super) fn coefficients(header: &Header) -> usize {
    header.element("sh").map_or(0, |sh| sh.names().filter(|name| name.starts_with("f_rest_")).count())
}

/// Bounds of a property over the splats of each chunk.
struct Bounds<'a> {
    chunks: &'a ElementTable<'a>,
    columns: [[usize; 2]; 3],
}

impl<'a> Bounds<'a> {
    fn find(chunks: &'a ElementTable<'a>, names: [&str; 3]) -> Option<Bounds<'a>> {
        let mut columns = [[0; 2]; 3];
        for (columns, name) in columns.iter_mut().zip(names) {
            *columns = [chunks.column(&format!("min_{name}"))?, chunks.column(&format!("max_{name}"))?];
        }
        Some(Bounds { chunks, columns })
    }

    /// Values at shares of the range of a chunk.
    fn at(&self, chunk: usize, shares: [f32; 3]) -> [f32; 3] {
        let value = |column| self.chunks.value(chunk, column) as f32;
        [0, 1, 2].map(|k| {
            let [least, most] = self.columns[k].map(value);
            least * (1.0 - shares[k]) + most * shares[k]
        })
    }
}

/// Reads such a file.
pub(super) fn read(path: &Path, bytes: &[u8], header: &Header) -> Result<Splats, SceneError> {
    let (chunks, packed) = (header.table(path, bytes, "chunk")?, header.table(path, bytes, "vertex")?);
    let missing = |name: &str| SceneError::invalid(path, "header", format!("there is no property `{name}`"));
    let bounds = |names: [&str; 3]| Bounds::find(&chunks, names).ok_or_else(|| missing(names[0]));
    let (positions, scales) = (bounds(["x", "y", "z"])?, bounds(["scale_x", "scale_y", "scale_z"])?);
    // Older files have no bounds of colours: these are of 0 to 1.
    let colours = Bounds::find(&chunks, ["r", "g", "b"]);
    let column = |name: &str| packed.column(name).ok_or_else(|| missing(name));
    let columns = [
        column("packed_position")?,
        column("packed_rotation")?,
        column("packed_scale")?,
        column("packed_color")?,
    ];
    let n = packed.len();
    if chunks.len() < n.div_ceil(CHUNK) {
        let reason = format!("{} chunks of {CHUNK} splats are too few for {n} splats", chunks.len());
        return Err(SceneError::invalid(path, "header", reason));
    }
    let count = coefficients(header);
    let rest = (count > 0).then(|| header.table(path, bytes, "sh")).transpose()?;
    let sh_degree = crate::ply::degree_of(path, count)?;
    if let Some(rest) = &rest
        && rest.len() != n
    {
        let reason = format!("it has the colour coefficients of {} splats, and {n} splats", rest.len());
        return Err(SceneError::invalid(path, "header", reason));
    }
    let coefficients: Vec<usize> = (0..count)
        .map(|k| {
            let name = format!("f_rest_{k}");
            rest.as_ref().and_then(|rest| rest.column(&name)).ok_or_else(|| missing(&name))
        })
        .collect::<Result<_, _>>()?;
    let mut splats = Splats { sh_degree, ..Splats::default() };
    for row in 0..n {
        let chunk = row / CHUNK;
        let [position, rotation, scale, colour] =
            columns.map(|column| packed.value(row, column).clamp(0.0, f64::from(u32::MAX)) as u32);
        splats.means.push(positions.at(chunk, thirds(position)));
        splats.log_scales.push(scales.at(chunk, thirds(scale)));
        splats.rotations.push(smallest_three(rotation));
        let [r, g, b, alpha] = [24, 16, 8, 0].map(|shift| share(colour >> shift, 8));
        let colour = colours.as_ref().map_or([r, g, b], |bounds| bounds.at(chunk, [r, g, b]));
        splats.sh.extend(colour.map(|c| (c - 0.5) / SH0));
        splats.opacities.push(stored_logit(alpha));
        if let Some(rest) = &rest {
            let bands = count / 3;
            for k in 0..bands {
                splats.sh.extend([0, 1, 2].map(|c| {
                    coefficient(rest.value(row, coefficients[c * bands + k]).clamp(0.0, 255.0) as u8)
                }));
            }
        }
    }
    Ok(splats)
}

/// The lowest bits of a number as a share of the largest that they hold.
fn share(value: u32, bits: u32) -> f32 {
    let most = (1u32 << bits) - 1;
    (value & most) as f32 / most as f32
}

/// Three shares in 11, 10 and 11 bits.
fn thirds(value: u32) -> [f32; 3] {
    [share(value >> 21, 11), share(value >> 11, 10), share(value, 11)]
}

/// A rotation (w, x, y, z): which component is the largest, and ten bits of each other.
fn smallest_three(value: u32) -> [f32; 4] {
    let others = [20, 10, 0].map(|shift| (share(value >> shift, 10) - 0.5) * std::f32::consts::SQRT_2);
    with_largest((value >> 30) as usize, others)
}

/// A colour coefficient, in the middle of its step; the ends are exact.
fn coefficient(value: u8) -> f32 {
    let share = match value {
        0 => 0.0,
        255 => 1.0,
        value => (f32::from(value) + 0.5) / 256.0,
    };
    (share - 0.5) * COEFFICIENTS
}
