//! Thumbnails of objects, and the sheet of all of them.

use super::bounds::bounds;
use segwild_scene::{Image, Mask};

/// Sides of a thumbnail in pixels.
const SIDE: usize = 160;
/// Pixels between thumbnails.
const GAP: usize = 4;
/// Thumbnails in a row of the sheet.
const COLUMNS: usize = 6;
/// Share of its size that is shown around an object.
const AROUND: f32 = 0.15;
/// Light of what is not the object, of its own.
const DIMMED: f32 = 0.3;
/// Light of the sheet's ground, and of a thumbnail without a photo.
const GROUND: f32 = 0.1;

/// The part of a photo that shows an object, in a square; the rest of the photo is darkened. `mask` has the photo's size.
pub(super) fn thumbnail(photo: Option<&Image>, mask: &Mask) -> Image {
    let mut square = Image::filled(SIDE, SIDE, 3, GROUND);
    let Some(photo) = photo.filter(|photo| photo.channels >= 3) else { return square };
    let Some((low, high)) = bounds(mask) else { return square };
    let extent = (high[0] - low[0]).max(high[1] - low[1]);
    let around = (AROUND * extent as f32).ceil() as u32;
    let full = [photo.width as u32, photo.height as u32];
    let from = low.map(|v| v.saturating_sub(around) as usize);
    let to = [0, 1].map(|k| (high[k] + around).min(full[k]) as usize);
    let size = [0, 1].map(|k| to[k].saturating_sub(from[k]).max(1));
    let mut crop = Image::zeros(size[0], size[1], 3);
    for c in 0..3 {
        for y in 0..size[1] {
            for x in 0..size[0] {
                let (u, v) = ((from[0] + x).min(photo.width - 1), (from[1] + y).min(photo.height - 1));
                let inside = mask.at(
                    (u as f32 + 0.5) / full[0] as f32 * mask.width() as f32,
                    (v as f32 + 0.5) / full[1] as f32 * mask.height() as f32,
                );
                let light = if inside { 1.0 } else { DIMMED };
                crop.data[(c * size[1] + y) * size[0] + x] = light * photo.at(c, u, v);
            }
        }
    }
    let scale = SIDE as f32 / size[0].max(size[1]) as f32;
    let fitted = size.map(|v| ((v as f32 * scale).round() as usize).clamp(1, SIDE));
    paste(&mut square, &crop.resized(fitted[0], fitted[1]), [(SIDE - fitted[0]) / 2, (SIDE - fitted[1]) / 2]);
    square
}

/// All thumbnails in rows, each with its number from 1.
pub(super) fn sheet(thumbnails: &[Image]) -> Image {
    let columns = thumbnails.len().clamp(1, COLUMNS);
    let rows = thumbnails.len().div_ceil(columns).max(1);
    let side = |count: usize| count * (SIDE + GAP) + GAP;
    let mut sheet = Image::filled(side(columns), side(rows), 3, GROUND);
    for (i, thumbnail) in thumbnails.iter().enumerate() {
        let corner = [side(i % columns), side(i / columns)];
        paste(&mut sheet, thumbnail, corner);
        write_number(&mut sheet, i + 1, corner);
    }
    sheet
}

fn paste(onto: &mut Image, image: &Image, corner: [usize; 2]) {
    for c in 0..3 {
        for y in 0..image.height {
            let to = (c * onto.height + corner[1] + y) * onto.width + corner[0];
            let from = (c * image.height + y) * image.width;
            onto.data[to..to + image.width].copy_from_slice(&image.data[from..from + image.width]);
        }
    }
}

/// The digits, three columns of five rows, a row per octal digit from the top.
const DIGITS: [u16; 10] =
    [0o75557, 0o26227, 0o71747, 0o71717, 0o55711, 0o74717, 0o74757, 0o71111, 0o75757, 0o75717];
/// Pixels per side of a digit's dot.
const DOT: usize = 3;

/// Writes a number in white on black.
fn write_number(image: &mut Image, number: usize, corner: [usize; 2]) {
    let mut fill = |from: [usize; 2], size: [usize; 2], light: f32| {
        for c in 0..3 {
            for y in from[1]..from[1] + size[1] {
                let row = (c * image.height + y) * image.width;
                image.data[row + from[0]..row + from[0] + size[0]].fill(light);
            }
        }
    };
    let text = number.to_string();
    fill(corner, [(4 * text.len() + 1) * DOT, 7 * DOT], 0.0);
    for (i, digit) in text.bytes().enumerate() {
        for dot in 0..15 {
            let (x, y) = (dot % 3, dot / 3);
            if DIGITS[usize::from(digit - b'0')] >> (14 - dot) & 1 == 1 {
                fill([corner[0] + (4 * i + 1 + x) * DOT, corner[1] + (1 + y) * DOT], [DOT; 2], 1.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thumbnail_shows_the_object_and_darkens_the_rest() {
        let photo = Image::filled(80, 60, 3, 0.8);
        let mask = Mask::from_fn(80, 60, |x, y| (30..50).contains(&x) && (20..40).contains(&y));
        let shown = thumbnail(Some(&photo), &mask);
        assert_eq!((shown.width, shown.height), (SIDE, SIDE));
        assert!((shown.at(0, SIDE / 2, SIDE / 2) - 0.8).abs() < 1e-3);
        assert!((shown.at(0, 2, 2) - 0.8 * DIMMED).abs() < 1e-3, "{}", shown.at(0, 2, 2));
        let nothing = thumbnail(None, &mask);
        assert!(nothing.data.iter().all(|&x| x == GROUND));
        assert_eq!(thumbnail(Some(&photo), &Mask::empty(80, 60)), nothing);
    }

    #[test]
    fn every_thumbnail_of_a_sheet_has_its_number() {
        let grey = Image::filled(SIDE, SIDE, 3, 0.5);
        let sheet = sheet(&vec![grey; 11]);
        assert_eq!((sheet.width, sheet.height), (6 * (SIDE + GAP) + GAP, 2 * (SIDE + GAP) + GAP));
        // Dots of `1` and of `11`.
        let white = |i: usize| {
            let (x, y) = (GAP + i % 6 * (SIDE + GAP), GAP + i / 6 * (SIDE + GAP));
            let number = (0..7 * DOT).flat_map(|v| (0..9 * DOT).map(move |u| (u, v)));
            number.filter(|&(u, v)| sheet.at(0, x + u, y + v) == 1.0).count() / (DOT * DOT)
        };
        assert_eq!((white(0), white(10)), (8, 16));
        assert_eq!(super::sheet(&[]).width, SIDE + 2 * GAP);
    }
}
