//! `.spz`, Niantic's packed splats: about a tenth of a `.ply`. Version 3, which every reader of the format knows: one gzip
//! stream of a header and one array per property (github.com/nianticlabs/spz, `docs` and `src/cc/load-spz.cc`).

use super::rotation::unit_rotation;
use crate::Splats;
use flate2::Compression;
use flate2::write::GzEncoder;
use std::io::Write;

/// `NGSP`, in little endian.
const MAGIC: u32 = 0x5053_474e;
/// Rotations by their three smallest components.
const VERSION: u32 = 3;
const ANTIALIASED: u8 = 1;
/// Bits of a position's coordinate, with its sign.
const POSITION_BITS: i32 = 24;
/// Most fractional bits: finer steps than a millionth of a unit help no reader.
const MOST_FRACTION: i32 = 20;
/// Colours are stored with room above 1 and below 0.
const COLOUR_SCALE: f32 = 0.15;
/// Bits of colour coefficients of the first degree, and of the others: the format's own choice.
const FIRST_DEGREE_BITS: u32 = 5;
const OTHER_DEGREES_BITS: u32 = 4;

/// The file of splats in the format's axes.
pub(super) fn to_bytes(splats: &Splats, antialias: bool) -> std::io::Result<Vec<u8>> {
    let fraction = fractional_bits(splats);
    let mut file = GzEncoder::new(Vec::new(), Compression::best());
    file.write_all(&MAGIC.to_le_bytes())?;
    file.write_all(&VERSION.to_le_bytes())?;
    file.write_all(&(splats.len() as u32).to_le_bytes())?;
    let flags = if antialias { ANTIALIASED } else { 0 };
    file.write_all(&[splats.sh_degree as u8, fraction as u8, flags, 0])?;
    let mut put = |bytes: Vec<u8>| file.write_all(&bytes);
    put(splats.means.iter().flat_map(|mean| mean.map(|v| position(v, fraction))).flatten().collect())?;
    put((0..splats.len()).map(|i| byte(splats.opacity(i) * 255.0)).collect())?;
    let colours = || splats.sh.chunks_exact(splats.sh_stride());
    let colour = |sh: &f32| byte(sh * COLOUR_SCALE * 255.0 + 0.5 * 255.0);
    put(colours().flat_map(|sh| sh[..3].iter().map(colour)).collect())?;
    put(splats.log_scales.iter().flat_map(|scale| scale.map(|v| byte((v + 10.0) * 16.0))).collect())?;
    put(splats.rotations.iter().flat_map(|q| smallest_three(*q).to_le_bytes()).collect())?;
    let coefficient = |(k, sh): (usize, &f32)| {
        let bits = if k < 9 { FIRST_DEGREE_BITS } else { OTHER_DEGREES_BITS };
        quantised(*sh, bits)
    };
    put(colours().flat_map(|sh| sh[3..].iter().enumerate().map(coefficient)).collect())?;
    file.finish()
}

/// Fractional bits with which the farthest position still fits.
fn fractional_bits(splats: &Splats) -> i32 {
    let far = splats.means.iter().flatten().filter(|v| v.is_finite()).fold(1.0f32, |far, v| far.max(v.abs()));
    // One bit is the sign; rounding may lift the farthest by half a step.
    (POSITION_BITS - 1 - (far * 1.001).log2().ceil() as i32).clamp(0, MOST_FRACTION)
}

fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

fn position(value: f32, fraction: i32) -> [u8; 3] {
    let most = (1 << (POSITION_BITS - 1)) - 1;
    let fixed = ((f64::from(value) * f64::from(1 << fraction)).round() as i32).clamp(-most, most);
    let [a, b, c, _] = fixed.to_le_bytes();
    [a, b, c]
}

/// A rotation (w, x, y, z): two bits for the largest component, and of each other one its sign and nine bits.
fn smallest_three(rotation: [f32; 4]) -> u32 {
    let whole = unit_rotation(rotation);
    let largest = (1..4).fold(0, |best, i| if whole[i].abs() > whole[best].abs() { i } else { best });
    let negative = whole[largest] < 0.0;
    let most = ((1 << 9) - 1) as f32;
    (0..4).filter(|&i| i != largest).fold(largest as u32, |packed, i| {
        let sign = u32::from((whole[i] < 0.0) != negative);
        let size = (most * whole[i].abs() / std::f32::consts::FRAC_1_SQRT_2 + 0.5) as u32;
        (packed << 10) | (sign << 9) | size.min((1 << 9) - 1)
    })
}

/// A colour coefficient of -1 to 1 with so many bits, the others zero, which gzip packs well.
fn quantised(value: f32, bits: u32) -> u8 {
    let step = 1 << (8 - bits);
    let fine = (value * 128.0).round() as i32 + 128;
    ((fine + step / 2).div_euclid(step) * step).clamp(0, 255) as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::read::GzDecoder;
    use std::io::Read;

    #[test]
    fn the_header_and_the_arrays_have_the_sizes_of_the_format() {
        let splats = Splats {
            means: vec![[1.0, -2.0, 0.5], [300.0, 0.0, 0.0]],
            log_scales: vec![[-3.0, 0.0, 2.0]; 2],
            rotations: vec![[1.0, 0.0, 0.0, 0.0], [0.0; 4]],
            opacities: vec![0.0, 20.0],
            sh_degree: 1,
            sh: vec![0.1; 24],
        };
        let mut bytes = Vec::new();
        GzDecoder::new(to_bytes(&splats, true).unwrap().as_slice()).read_to_end(&mut bytes).unwrap();
        assert_eq!(bytes.len(), 16 + 2 * (9 + 1 + 3 + 3 + 4 + 9));
        assert_eq!(&bytes[..12], [b'N', b'G', b'S', b'P', 3, 0, 0, 0, 2, 0, 0, 0]);
        assert_eq!(&bytes[12..16], [1, 14, ANTIALIASED, 0]);
        let fixed = |at: usize| i32::from_le_bytes([0, bytes[at], bytes[at + 1], bytes[at + 2]]) >> 8;
        assert_eq!((fixed(16), fixed(19), fixed(25)), (1 << 14, -2 << 14, 300 << 14));
        assert_eq!(&bytes[34..36], [128, 255], "opacities");
        assert_eq!(&bytes[42..45], [112, 160, 192], "scales");
        assert_eq!(
            bytes[48..56].chunks(4).map(|q| q[3]).collect::<Vec<_>>(),
            [0xc0, 0xc0],
            "w is the largest"
        );
    }

    #[test]
    fn a_rotation_and_its_negative_are_one() {
        for q in [[0.1, 0.7, -0.7, 0.1], [0.9, -0.1, 0.3, 0.2], [-0.5, 0.5, 0.5, -0.5]] {
            assert_eq!(smallest_three(q), smallest_three(q.map(|v| -v)));
        }
    }

    #[test]
    fn values_outside_the_format_are_its_largest() {
        assert_eq!((quantised(7.0, 5), quantised(-7.0, 4), quantised(0.0, 4)), (255, 0, 128));
        assert_eq!(position(f32::INFINITY, 12), position(1e9, 12));
        assert_eq!(byte(f32::NAN), 0);
    }
}
