//! Crops of photos that show one group and hardly anything else.

use crate::output::objects::bounds;
use segwild_scene::{Image, Mask};
use segwild_vision::CLIP_MEAN;

/// Share of a group's size that is shown around it (docs/method.md, section 13.1). By choice.
const AROUND: f32 = 0.15;
/// Share of its own colour that is left to what is not the group: enough to tell where it stands (section 13.1). By choice.
const SURROUNDINGS: f32 = 0.2;
/// Side of a crop at most, in pixels: the largest that published CLIP models take.
const MOST_SIDE: usize = 336;

/// The square of a photo around a mask, faded to the mean colour of CLIP's training images where it is not the mask: pixels
/// of this colour are 0 after standardisation. `None` where the mask is empty.
pub(super) fn crop(photo: &Image, mask: &Mask) -> Option<Image> {
    if photo.channels < 3 {
        return None;
    }
    let mask = mask.resized(photo.width as u32, photo.height as u32);
    let (low, high) = bounds(&mask)?;
    let extent = (high[0] - low[0]).max(high[1] - low[1]) as f32;
    let side = ((1.0 + 2.0 * AROUND) * extent).round().max(1.0) as usize;
    // Its corner may lie outside of the photo.
    let corner = [0, 1].map(|k| (i64::from(low[k]) + i64::from(high[k]) - side as i64) / 2);
    let mut crop = Image::zeros(side, side, 3);
    for c in 0..3 {
        for y in 0..side {
            for x in 0..side {
                let (u, v) = (corner[0] + x as i64, corner[1] + y as i64);
                let inside = (0..photo.width as i64).contains(&u) && (0..photo.height as i64).contains(&v);
                let own = match inside {
                    true if mask.get(u as u32, v as u32) => 1.0,
                    true => SURROUNDINGS,
                    false => 0.0,
                };
                let colour = if inside { photo.at(c, u as usize, v as usize) } else { 0.0 };
                crop.data[(c * side + y) * side + x] = own * colour + (1.0 - own) * CLIP_MEAN[c];
            }
        }
    }
    Some(if side > MOST_SIDE { crop.resized(MOST_SIDE, MOST_SIDE) } else { crop })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crop_is_a_square_of_the_mask_with_its_surroundings_faded() {
        let photo = Image::filled(80, 60, 3, 0.9);
        let mask = Mask::from_fn(80, 60, |x, y| (60..80).contains(&x) && (0..10).contains(&y));
        let shown = crop(&photo, &mask).unwrap();
        assert_eq!((shown.width, shown.height), (26, 26));
        let near = |a: f32, b: f32| (a - b).abs() < 1e-5;
        // Its middle is that of the mask, (70, 5), so that its upper part and its right rim lie outside of the photo.
        assert!(near(shown.at(0, 13, 13), 0.9), "the group");
        assert!(
            near(shown.at(0, 13, 2), CLIP_MEAN[0]) && near(shown.at(2, 25, 13), CLIP_MEAN[2]),
            "no photo"
        );
        assert!(
            near(shown.at(1, 13, 24), SURROUNDINGS * 0.9 + (1.0 - SURROUNDINGS) * CLIP_MEAN[1]),
            "around it"
        );
        assert_eq!(crop(&photo, &Mask::empty(80, 60)), None);
        let large = crop(&Image::filled(1000, 800, 3, 0.5), &Mask::full(1000, 800)).unwrap();
        assert_eq!((large.width, large.height), (MOST_SIDE, MOST_SIDE));
    }
}
