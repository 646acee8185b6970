//! `.spz`, Niantic's packed splats: a header, and one array per property. Versions 1 to 3 are one gzip stream, which
//! some programs leave out; version 4 packs each array by zstd (github.com/nianticlabs/spz, `src/cc/load-spz.cc`).
//! Behind the arrays, in version 4 before them, stand the extensions of programs (`extensions/README.md`); Spark's tree
//! of levels of detail comes first.

use super::program::lichtfeld;
use super::quantised::{stored_logit, with_largest};
use crate::{SceneError, Similarity, Splats};
use flate2::read::GzDecoder;
use glam::DMat3;
use ruzstd::decoding::StreamingDecoder;
use std::io::Read;
use std::path::Path;

/// How such a file begins.
const MAGIC: &[u8; 4] = b"NGSP";
/// How any gzip stream begins.
const GZIP: [u8; 2] = [0x1f, 0x8b];
/// Bytes of the header up to version 3, and since version 4.
const HEADER: usize = 16;
const LONG_HEADER: usize = 32;
/// Flags: splats that are compensated for the pixel filter; extensions; Spark's levels of detail.
const ANTIALIASED: u8 = 1;
const HAS_EXTENSIONS: u8 = 2;
const HAS_LEVELS: u8 = 0x80;
/// Most bytes behind the arrays that are unpacked.
const MOST_EXTENSIONS: u64 = 64 << 20;
/// Bytes of a splat in a tree of levels: how many children it has, and which is the first. All counts come first.
const LEVEL_COUNT: usize = 2;
const LEVEL: usize = LEVEL_COUNT + 4;
/// The extension of the axes (`SPZ_ADOBE_coordinate_system`): one of the numbers from 1 to [`MOST_AXES`].
const AXES_EXTENSION: usize = 0xadbe_0003;
const MOST_AXES: usize = 16;
/// The axes of a file that declares none: x right, y up, z back.
const RIGHT_UP_BACK: usize = 4;
/// The last of the axes whose second one is up or down; that of the others is forward or back.
const LAST_WITH_Y_UP: usize = 8;
/// Highest degree of colours in a file; of the fourth, the lower ones are read.
const DEGREES: u8 = 4;
/// Colours are stored with room above 1 and below 0.
const COLOUR_SCALE: f32 = 0.15;

/// What the header of a file says.
#[derive(Clone, Debug)]
pub(super) struct SpzHead {
    version: u32,
    pub splats: usize,
    stored_degree: u32,
    fraction: u32,
    flags: u8,
    /// The program that wrote it, where the file tells.
    pub program: Option<String>,
}

impl SpzHead {
    /// Degree of the colours that are read.
    pub fn sh_degree(&self) -> u32 {
        self.stored_degree.min(3)
    }

    /// Whether opacities are compensated for the pixel filter.
    pub fn antialias(&self) -> bool {
        self.has(ANTIALIASED)
    }

    fn has(&self, flag: u8) -> bool {
        self.flags & flag != 0
    }

    /// Bytes of the tree of levels of detail.
    fn tree(&self) -> usize {
        if self.version < 4 && self.has(HAS_LEVELS) { self.splats * LEVEL } else { 0 }
    }

    /// Bytes per splat of each array, in the order in which they stand.
    fn strides(&self) -> [usize; 6] {
        let position = if self.version == 1 { 6 } else { 9 };
        let rotation = if self.version >= 3 { 4 } else { 3 };
        let rest = (3 * ((self.stored_degree + 1).pow(2) - 1)) as usize;
        [position, 1, 3, 3, rotation, rest]
    }

    fn parse(path: &Path, bytes: &[u8; HEADER]) -> Result<SpzHead, SceneError> {
        let invalid = |reason: String| SceneError::invalid(path, "header", reason);
        if !bytes.starts_with(MAGIC) {
            return Err(invalid("it is a packed file, and none of splats (`.spz`)".into()));
        }
        let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        let [version, splats] = [4, 8].map(word);
        let [degree, fraction, flags] = [bytes[12], bytes[13], bytes[14]];
        if !(1..=4).contains(&version) {
            let reason =
                format!("it is of version {version} of `.spz`, and 1 to 4 are read: write it as .ply");
            return Err(invalid(reason));
        }
        if degree > DEGREES || fraction > 24 {
            return Err(invalid(format!("degree {degree} with {fraction} fractional bits cannot be")));
        }
        let head = SpzHead {
            version,
            splats: splats as usize,
            stored_degree: degree.into(),
            fraction: fraction.into(),
            flags,
            program: None,
        };
        Ok(SpzHead { program: (head.tree() > 0).then(|| "Spark".to_owned()), ..head })
    }
}

/// Whether a file begins as one of these, or as any gzip stream.
pub(super) fn is_packed(start: &[u8]) -> bool {
    start.starts_with(&GZIP) || start.starts_with(MAGIC)
}

/// Reads the header from the start of a file.
pub(super) fn head(path: &Path, start: &[u8]) -> Result<SpzHead, SceneError> {
    let mut bytes = [0; HEADER];
    let read = match start.starts_with(&GZIP) {
        true => GzDecoder::new(start).read_exact(&mut bytes),
        false => (&mut &*start).read_exact(&mut bytes),
    };
    read.map_err(|e| {
        SceneError::invalid(path, "header", format!("it is packed, and cannot be unpacked as `.spz`: {e}"))
    })?;
    let mut head = SpzHead::parse(path, &bytes)?;
    if head.version >= 4 && head.has(HAS_EXTENSIONS) {
        let extensions = contents(start).and_then(|at| start.get(LONG_HEADER..at)).unwrap_or_default();
        let mut notes = records(extensions).filter_map(|(_, payload)| std::str::from_utf8(payload).ok());
        let named = notes.find_map(lichtfeld);
        head.program = head.program.or(named);
    }
    Ok(head)
}

/// The number that some bytes of a file hold.
fn number(bytes: &[u8], at: usize, size: usize) -> Option<usize> {
    let bytes = bytes.get(at..at.checked_add(size)?)?;
    let value = bytes.iter().rev().fold(0u64, |value, b| value << 8 | u64::from(*b));
    usize::try_from(value).ok()
}

/// Where the table of contents of version 4 stands. The extensions come before it.
fn contents(bytes: &[u8]) -> Option<usize> {
    number(bytes, 16, 4).filter(|&at| at >= LONG_HEADER)
}

/// The extensions of a file: the number of each, and its data. What is cut short ends them.
fn records(bytes: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    let mut left = bytes;
    std::iter::from_fn(move || {
        let (kind, length) = (number(left, 0, 4)?, number(left, 4, 4)?);
        let (payload, after) = left.get(8..)?.split_at_checked(length)?;
        left = after;
        Some((kind, payload))
    })
}

/// The axes that the extensions declare.
fn axes(extensions: &[u8]) -> usize {
    let declared = records(extensions).filter(|(kind, _)| *kind == AXES_EXTENSION);
    let mut axes = declared.filter_map(|(_, payload)| number(payload, 0, 4));
    axes.find(|axes| (1..=MOST_AXES).contains(axes)).unwrap_or(RIGHT_UP_BACK)
}

/// Unpacks the arrays of a file. After them comes what else it holds: the tree of levels, the extensions.
fn arrays(path: &Path, bytes: &[u8], head: &SpzHead) -> Result<([Vec<u8>; 6], Vec<u8>), SceneError> {
    let damaged = |e: &dyn std::fmt::Display| SceneError::invalid(path, "the packed data", e);
    let mut arrays: [Vec<u8>; 6] = Default::default();
    let mut more = Vec::new();
    let lengths = head.strides().map(|stride| head.splats * stride);
    if head.version < 4 {
        let mut stream: Box<dyn Read + '_> = match bytes.starts_with(&GZIP) {
            true => Box::new(GzDecoder::new(bytes)),
            false => Box::new(bytes),
        };
        stream.read_exact(&mut [0; HEADER]).map_err(|e| damaged(&e))?;
        for (array, length) in arrays.iter_mut().zip(lengths) {
            // What a damaged head promises is not reserved before it is there.
            stream.by_ref().take(length as u64).read_to_end(array).map_err(|e| damaged(&e))?;
        }
        // The check sum comes after what else a file may hold.
        stream.take(MOST_EXTENSIONS).read_to_end(&mut more).map_err(|e| damaged(&e))?;
    } else {
        // The table of contents has the packed and the whole length of each array that is not empty.
        let number = |at: usize, size: usize| number(bytes, at, size);
        let streams = usize::from(bytes[15]);
        let cut = || damaged(&"its table of contents is cut short");
        let contents = contents(bytes).ok_or_else(cut)?;
        more.extend(bytes.get(LONG_HEADER..contents).ok_or_else(cut)?);
        let mut at = contents + 16 * streams;
        let present = arrays.iter_mut().zip(lengths).filter(|(_, length)| *length > 0);
        for (stream, (array, length)) in present.enumerate() {
            let packed = number(contents + 16 * stream, 8).filter(|_| stream < streams).ok_or_else(cut)?;
            let packed = at.checked_add(packed).and_then(|end| bytes.get(at..end)).ok_or_else(cut)?;
            at += packed.len();
            let mut unpacked = StreamingDecoder::new(packed).map_err(|e| damaged(&e))?;
            unpacked.by_ref().take(length as u64).read_to_end(array).map_err(|e| damaged(&e))?;
        }
    }
    for (array, length) in arrays.iter().zip(lengths) {
        if array.len() < length {
            let reason = format!("it ends after {} of {length} bytes of an array", array.len());
            return Err(damaged(&reason));
        }
    }
    Ok((arrays, more))
}

/// Reads such a file, in the axes of `.ply`, and says in words what else was done.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<(Splats, Vec<String>), SceneError> {
    let head = head(path, bytes)?;
    let ([positions, alphas, colours, scales, rotations, rest], more) = arrays(path, bytes, &head)?;
    let mut notes = Vec::new();
    let (tree, extensions) = more.split_at_checked(head.tree()).ok_or_else(|| {
        SceneError::invalid(path, "the packed data", "it ends within the tree of its levels of detail")
    })?;
    // With levels, opacities up to 2 are stored.
    let most_opaque = if tree.is_empty() { 1.0 } else { 2.0 };
    let mut splats = Splats { sh_degree: head.sh_degree(), ..Splats::default() };
    let [position, _, _, _, rotation, coefficients] = head.strides();
    let kept = splats.sh_stride() - 3;
    for i in 0..head.splats {
        splats.means.push(match head.version {
            1 => position_of_halves(&positions[position * i..]),
            _ => fixed_point(&positions[position * i..], head.fraction),
        });
        splats.opacities.push(stored_logit(most_opaque * f32::from(alphas[i]) / 255.0));
        let colour = |c: usize| (f32::from(colours[3 * i + c]) / 255.0 - 0.5) / COLOUR_SCALE;
        splats.sh.extend([0, 1, 2].map(colour));
        splats.log_scales.push([0, 1, 2].map(|c| f32::from(scales[3 * i + c]) / 16.0 - 10.0));
        splats.rotations.push(match rotations[rotation * i..][..rotation] {
            [a, b, c, d] => smallest_three(u32::from_le_bytes([a, b, c, d])),
            ref three => first_three([three[0], three[1], three[2]]),
        });
        let own = &rest[coefficients * i..][..kept];
        splats.sh.extend(own.iter().map(|&v| (f32::from(v) - 128.0) / 128.0));
    }
    if !tree.is_empty() {
        // A splat with children stands in for them from afar.
        let has_none = |i: &usize| tree[LEVEL_COUNT * i..][..LEVEL_COUNT] == [0; LEVEL_COUNT];
        let finest: Vec<usize> = (0..head.splats).filter(has_none).collect();
        let (all, coarse) = (head.splats, head.splats - finest.len());
        notes.push(format!("{coarse} of {all} splats are left out: they are of coarser levels of detail"));
        splats = splats.select(&finest);
    }
    let axes = if head.has(HAS_EXTENSIONS) { axes(extensions) } else { RIGHT_UP_BACK };
    if axes != RIGHT_UP_BACK {
        notes.push(format!("its axes are declared as {}", axes_in_words(axes)));
    }
    Ok((in_axes_of_ply(&splats, axes), notes))
}

/// Which way axes point: the first to the right, the second or third up, the third or second ahead.
fn ways(axes: usize) -> [bool; 3] {
    let bit = |k: usize| (axes - 1) >> k & 1 == 1;
    let ahead = if axes <= LAST_WITH_Y_UP { bit(2) } else { !bit(2) };
    [bit(0), bit(1), ahead]
}

fn axes_in_words(axes: usize) -> String {
    let [right, up, ahead] = ways(axes);
    let x = if right { "right" } else { "left" };
    let (vertical, depth) = (if up { "up" } else { "down" }, if ahead { "forward" } else { "back" });
    match axes <= LAST_WITH_Y_UP {
        true => format!("x {x}, y {vertical}, z {depth}"),
        false => format!("x {x}, y {depth}, z {vertical}"),
    }
}

/// Splats in the axes of `.ply`: x right, y down, z forward.
fn in_axes_of_ply(splats: &Splats, axes: usize) -> Splats {
    let [right, up, ahead] = ways(axes);
    let sign = |plus: bool| if plus { 1.0 } else { -1.0 };
    if axes <= LAST_WITH_Y_UP {
        return splats.flipped([sign(right), sign(!up), sign(ahead)]);
    }
    // First x right, y forward, z up; then a quarter turn, which leads z against y.
    let upright = splats.flipped([sign(right), sign(ahead), sign(up)]);
    upright.transformed(&Similarity::turn(DMat3::from_rotation_x(std::f64::consts::FRAC_PI_2)))
}

fn fixed_point(bytes: &[u8], fraction: u32) -> [f32; 3] {
    [0, 3, 6].map(|at| {
        // The sign of the third byte is that of the number.
        let fixed = i32::from_le_bytes([0, bytes[at], bytes[at + 1], bytes[at + 2]]) >> 8;
        fixed as f32 / (1u32 << fraction) as f32
    })
}

/// Version 1 has positions as 16-bit floats.
fn position_of_halves(bytes: &[u8]) -> [f32; 3] {
    [0, 2, 4].map(|at| half(u16::from_le_bytes([bytes[at], bytes[at + 1]])))
}

/// A 16-bit float.
fn half(bits: u16) -> f32 {
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    let (exponent, mantissa) = (i32::from(bits >> 10 & 0x1f), f32::from(bits & 0x3ff));
    sign * match exponent {
        0 => mantissa * 2f32.powi(-24),
        31 if mantissa == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        _ => (1.0 + mantissa / 1024.0) * 2f32.powi(exponent - 15),
    }
}

/// A rotation (w, x, y, z) of version 1 and 2: x, y and z, with w the rest and positive.
fn first_three(bytes: [u8; 3]) -> [f32; 4] {
    let [x, y, z] = bytes.map(|v| f32::from(v) / 127.5 - 1.0);
    [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
}

/// A rotation (w, x, y, z) of version 3: which component of x, y, z, w is the largest, and of each other one its sign and nine
/// bits, the last component lowest.
fn smallest_three(packed: u32) -> [f32; 4] {
    let largest = (packed >> 30) as usize;
    let others = [20, 10, 0].map(|shift| {
        let size = ((packed >> shift) & 0x1ff) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
        if packed >> (shift + 9) & 1 == 1 { -size } else { size }
    });
    let [x, y, z, w] = with_largest(largest, others);
    [w, x, y, z]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_are_ieee_halves() {
        let cases = [(0x3c00, 1.0), (0xc000, -2.0), (0x3555, 0.333_251_95), (0x0001, 5.960_464_5e-8)];
        for (bits, value) in cases {
            assert_eq!(half(bits), value);
        }
        assert!(half(0x7c00).is_infinite() && half(0x7e00).is_nan());
    }
}
