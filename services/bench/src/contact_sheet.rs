//! Images side by side in pairs: photos beside their renders, true masks beside answers.

use segwild_scene::Image;

/// Width of each image, in pixels.
const SHOWN: usize = 240;
/// Pairs in a row.
const ACROSS: usize = 3;
/// What fills the sheet where there is no image.
const BACKGROUND: f32 = 0.12;

/// Pairs of images of three channels, in rows; both of a pair are as high as the first of them.
pub(crate) fn contact_sheet(pairs: &[[&Image; 2]]) -> Image {
    let height = |pair: &[&Image; 2]| (SHOWN * pair[0].height).div_ceil(pair[0].width.max(1));
    let row = pairs.iter().map(height).max().unwrap_or(1);
    let across = ACROSS.min(pairs.len());
    let mut sheet =
        Image::filled(2 * SHOWN * across, row * pairs.len().div_ceil(across.max(1)), 3, BACKGROUND);
    let (wide, n) = (sheet.width, sheet.pixels());
    for (k, pair) in pairs.iter().enumerate() {
        for (side, image) in pair.iter().enumerate() {
            let small = image.resized(SHOWN, height(pair));
            let (left, top) = ((2 * (k % across) + side) * SHOWN, (k / across) * row);
            for c in 0..3 {
                for (y, line) in small.plane(c).chunks_exact(SHOWN).enumerate() {
                    let at = c * n + (top + y) * wide + left;
                    sheet.data[at..at + SHOWN].copy_from_slice(line);
                }
            }
        }
    }
    sheet
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_photo_is_shown_beside_its_render() {
        let [photo, render] = [1.0, 0.5].map(|value| Image::filled(480, 320, 3, value));
        let sheet = contact_sheet(&[[&photo, &render]; 4]);
        assert_eq!((sheet.width, sheet.height), (6 * SHOWN, 2 * 160));
        assert_eq!((sheet.at(0, 10, 10), sheet.at(0, SHOWN + 10, 10)), (1.0, 0.5));
        assert_eq!((sheet.at(2, 10, 170), sheet.at(1, 3 * SHOWN, 170)), (1.0, BACKGROUND));
    }
}
