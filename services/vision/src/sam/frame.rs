//! How a photo lies in a SAM encoder's square input, and the pre-processing for the encoder.
//!
//! SAM and MobileSAM: the photo is scaled so that its long side fills the square, standardised, and padded with zeros to
//! the right and below. SAM 2 and SAM 3's tracker: each side is scaled for itself, so that the photo fills the whole square.
//! EfficientSAM does that inside the file.

use segwild_scene::Image;

/// Mean of each channel over SAM's training photos, in [0, 255], and the standard deviation.
pub(super) const MEAN: [f32; 3] = [123.675, 116.28, 103.53];
/// See [`MEAN`].
pub(super) const DEVIATION: [f32; 3] = [58.395, 57.12, 57.375];

/// Where a photo lies in the encoder's square.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PhotoFit {
    /// Width and height of the photo.
    pub photo: [usize; 2],
    /// Width and height of its part of the square.
    pub content: [usize; 2],
    /// Side of the square; `None` where the photo fills it whatever its aspect.
    pub side: Option<usize>,
}

impl PhotoFit {
    /// Scaled to fit into `width` x `height` pixels of a square of the longer of them.
    pub fn into(photo: [usize; 2], [width, height]: [usize; 2]) -> PhotoFit {
        let scale = (width as f64 / photo[0] as f64).min(height as f64 / photo[1] as f64);
        // Rounded as the published code rounds: half up.
        let scaled = |n: usize, most: usize| ((n as f64 * scale + 0.5) as usize).clamp(1, most);
        PhotoFit {
            photo,
            content: [scaled(photo[0], width), scaled(photo[1], height)],
            side: Some(width.max(height)),
        }
    }

    /// Stretched over all of `width` x `height` pixels, which the decoder speaks of.
    pub fn stretched(photo: [usize; 2], content: [usize; 2]) -> PhotoFit {
        PhotoFit { photo, content, side: None }
    }

    /// Filling the whole square; the decoder speaks of the photo's own pixels.
    pub fn filling(photo: [usize; 2]) -> PhotoFit {
        PhotoFit { photo, content: photo, side: None }
    }

    /// Where a pixel position of the photo lies for the decoder.
    pub fn point(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let along = |v: f32, axis: usize| v * self.content[axis] as f32 / self.photo[axis] as f32;
        [along(x, 0), along(y, 1)]
    }

    /// Columns and rows of a grid of `width` x `height` cells over the square that the photo covers, rounded.
    pub fn cells(&self, width: usize, height: usize) -> [usize; 2] {
        let covered = |cells: usize, axis: usize| match self.side {
            None => cells,
            Some(side) => {
                ((cells * self.content[axis]) as f64 / side as f64).round().clamp(1.0, cells as f64) as usize
            }
        };
        [covered(width, 0), covered(height, 1)]
    }
}

/// What kind of numbers an encoder takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Range {
    /// Standardised by [`MEAN`] and [`DEVIATION`].
    Standard,
    /// In [-1, 1].
    Centred,
    /// In [0, 1]: the file standardises.
    Unit,
    /// In [0, 255]: the file standardises.
    Byte,
}

/// The photo as three planes for the encoder, `width` x `height`: scaled to the fit's content (or to the whole, where it
/// fills), padded with what standardises to zero.
pub(super) fn prepare(photo: &Image, fit: &PhotoFit, [width, height]: [usize; 2], range: Range) -> Image {
    let [w, h] = if fit.side.is_some() { fit.content } else { [width, height] };
    let scaled = photo.resized(w, h);
    let mut out = Image::zeros(width, height, 3);
    for c in 0..3 {
        // Numbers that are none would make the whole embedding such.
        let number = |v: f32| if v.is_finite() { v } else { 0.0 };
        let (value, padding): (Box<dyn Fn(f32) -> f32>, f32) = match range {
            Range::Standard => (Box::new(move |v| (255.0 * number(v) - MEAN[c]) / DEVIATION[c]), 0.0),
            Range::Centred => (Box::new(move |v| 2.0 * number(v) - 1.0), 0.0),
            Range::Unit => (Box::new(number), MEAN[c] / 255.0),
            Range::Byte => (Box::new(move |v| 255.0 * number(v)), MEAN[c]),
        };
        let from = scaled.plane(c);
        let plane = out.plane_mut(c);
        plane.fill(padding);
        for y in 0..h {
            for x in 0..w {
                plane[y * width + x] = value(from[y * w + x]);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sam_interface::SIDE;

    #[test]
    fn a_photo_is_scaled_rounded_and_padded_as_published() {
        // ResizeLongestSide.get_preprocess_shape of the published code, worked out by hand.
        for (photo, content) in [
            ([640, 427], [1024, 683]), // 683.2
            ([427, 640], [683, 1024]),
            ([1500, 1001], [1024, 683]), // 683.35
            ([3, 2], [1024, 683]),       // 682.67
            ([1024, 1], [1024, 1]),
            ([7, 7], [1024, 1024]),
        ] {
            let fit = PhotoFit::into(photo, [SIDE, SIDE]);
            assert_eq!((fit.content, fit.side), (content, Some(1024)), "{photo:?}");
        }
        // An encoder for landscapes: 684 rows, of which the square's lower part is left out.
        let fit = PhotoFit::into([640, 480], [1024, 684]);
        assert_eq!((fit.content, fit.side), ([912, 684], Some(1024)));
        // A photo so wide that a row is all there is.
        assert_eq!(PhotoFit::into([10_000, 1], [SIDE, SIDE]).content, [1024, 1]);
    }

    #[test]
    fn points_and_cells_follow_the_photo() {
        let fit = PhotoFit::into([640, 427], [SIDE, SIDE]);
        assert_eq!(fit.point([320.0, 213.5]), [512.0, 341.5]);
        assert_eq!(fit.cells(64, 64), [64, 43]); // 42.69
        assert_eq!(fit.cells(256, 256), [256, 171]); // 170.75
        let whole = PhotoFit::filling([640, 427]);
        assert_eq!((whole.point([320.0, 213.5]), whole.cells(64, 64)), ([320.0, 213.5], [64, 64]));
        // SAM2Transforms of the published code: each axis by itself, the middle of the photo in the middle of the square.
        let stretched = PhotoFit::stretched([640, 427], [SIDE, SIDE]);
        assert_eq!((stretched.point([320.0, 213.5]), stretched.cells(64, 64)), ([512.0, 512.0], [64, 64]));
        assert_eq!(PhotoFit::stretched([640, 320], [1008, 1008]).point([64.0, 64.0]), [100.8, 201.6]);
    }

    #[test]
    fn the_numbers_are_those_of_the_published_formula() {
        // Two pixels, white and a grey, grown to four by linear interpolation between pixel centres.
        let photo = Image { width: 2, height: 1, channels: 3, data: vec![1.0, 0.2, 1.0, 0.2, 1.0, 0.2] };
        let fit = PhotoFit::into([2, 1], [4, 4]);
        assert_eq!(fit.content, [4, 2]);
        let made = prepare(&photo, &fit, [4, 4], Range::Standard);
        // Values 1, 0.8, 0.4, 0.2: centres at 0.25 and 0.75 of the way between the two.
        let expected = [
            [2.2489083, 1.3755459, -0.37117908, -1.2445415],
            [2.4285715, 1.5357143, -0.25, -1.1428572],
            [2.6400001, 1.7511111, -0.026666632, -0.91555555],
        ];
        for c in 0..3 {
            for x in 0..4 {
                for y in 0..2 {
                    let got = made.at(c, x, y);
                    assert!((got - expected[c][x]).abs() < 1e-5, "{c} {x} {y}: {got}");
                }
                assert_eq!((made.at(c, x, 2), made.at(c, x, 3)), (0.0, 0.0), "padding is zero");
            }
        }
        let bytes = prepare(&photo, &fit, [4, 4], Range::Byte);
        assert_eq!((bytes.at(0, 0, 0), bytes.at(2, 3, 1), bytes.at(1, 0, 3)), (255.0, 51.0, 116.28));
        // EfficientSAM: stretched over all of it, in [0, 1], standardised by the file.
        let whole = prepare(&photo, &PhotoFit::filling([2, 1]), [4, 4], Range::Unit);
        assert_eq!((whole.at(0, 0, 0), whole.at(0, 3, 3)), (1.0, 0.2));
        // SAM 2: stretched by us, standardised. SAM 3: the same in [-1, 1].
        let stretched = PhotoFit::stretched([2, 1], [4, 4]);
        let made = prepare(&photo, &stretched, [4, 4], Range::Standard);
        assert!((made.at(0, 0, 0) - expected[0][0]).abs() < 1e-5 && made.at(0, 0, 0) == made.at(0, 0, 3));
        let centred = prepare(&photo, &stretched, [4, 4], Range::Centred);
        assert!((centred.at(1, 0, 3) - 1.0).abs() < 1e-6 && (centred.at(1, 3, 0) + 0.6).abs() < 1e-6);
    }

    #[test]
    fn a_pixel_that_is_no_number_does_not_spoil_the_rest() {
        let photo = Image { width: 1, height: 1, channels: 3, data: vec![f32::NAN, f32::INFINITY, 0.5] };
        for range in [Range::Standard, Range::Centred, Range::Unit, Range::Byte] {
            let made = prepare(&photo, &PhotoFit::into([1, 1], [2, 2]), [2, 2], range);
            assert!(made.data.iter().all(|v| v.is_finite()));
        }
    }
}
