//! Images as masks: each is thresholded by its own range, whatever program wrote it.

use crate::decode::{MEGAPIXELS, open_file, pixels_of};
use crate::{Mask, SceneError};
use image::DynamicImage;
use std::io::Read;
use std::path::Path;

/// The largest value of a sample here, whatever the depth of the file.
const TOP: f32 = 65535.0;
/// Part of a mask's range that counts as its end.
const END: f32 = 1.0 / 12.0;
/// Least share of the pixels at the ends of the range: the rest are soft edges.
const TWO_VALUED: f64 = 2.0 / 3.0;
/// Most of the pixels that may lie amid others of the same value between the ends: soft edges are never flat.
const FLAT: f64 = 0.01;
/// Most values that are taken for numbers of regions, such as 0, 1 and 255 for background, object and void.
const NUMBERS: usize = 8;
/// Most of the pixels whose colour may be off the line between the two colours by more than an eighth.
const COLOURED: f64 = 0.02;
/// Part of the whole range below which the values of a lossy file differ by its losses, and those of another are numbers.
const NARROW: f32 = TOP / 8.0;

impl Mask {
    /// Reads a mask from an image: its bright pixels, by the range of its own values.
    ///
    /// - Two values, whichever they are (0 and 255, 0 and 1, 0 and 65535, two colours of a palette): the brighter is inside.
    /// - Soft edges, and the ringing of JPEG: over the middle of the range is inside.
    /// - One value alone: 0 is nothing; 1, or the largest that the file can hold, is everything.
    /// - Alpha: what is transparent is outside; where all colours are one, alpha itself is the mask.
    ///
    /// # Errors
    /// The file cannot be read, or is no mask: a photo, a single grey, or an image of several numbered regions.
    pub fn read_png(path: &Path) -> Result<Mask, SceneError> {
        Mask::read_within(path, pixels_of(MEGAPIXELS))
    }

    /// The same, of at most so many pixels.
    pub(crate) fn read_within(path: &Path, most_pixels: u64) -> Result<Mask, SceneError> {
        let decoded = crate::image::read_file_within(path, most_pixels)?;
        mask_of(&decoded, is_lossy(path)).map_err(|e| SceneError::invalid(path, "image", e))
    }
}

/// Why an image is no mask.
#[derive(Debug, thiserror::Error)]
enum MaskImageError {
    #[error("it has many colours: this is a photo or an illustration, not a mask of two values")]
    Coloured,
    /// The grey is in steps of the file.
    #[error(
        "all of it is one grey ({grey}): 0 means nothing of the photo, and 1 or the largest value all of it"
    )]
    OneGrey { grey: u16 },
    #[error(
        "its values are {low} to {high}, neither dark nor bright: write the mask as PNG, black and white"
    )]
    LossyGrey { low: u16, high: u16 },
    #[error(
        "its values are {low} to {high}, several and not two: an image of numbered regions is no mask; write one with two values"
    )]
    Numbers { low: u16, high: u16 },
    #[error("{percent:.0} % of it is neither dark nor bright: this is a photo, not a mask of two values")]
    Photo { percent: f64 },
    #[error(
        "{percent:.0} % of it are areas of a third value: an image of several regions is no mask; write one with two values"
    )]
    Regions { percent: f64 },
}

/// Whether the file's format changes values a little: JPEG, or WEBP, which may.
fn is_lossy(path: &Path) -> bool {
    let mut start = [0; 4];
    let read = open_file(path).and_then(|mut file| file.read_exact(&mut start));
    read.is_ok() && (start[..2] == [0xff, 0xd8] || &start == b"RIFF")
}

fn mask_of(decoded: &DynamicImage, lossy: bool) -> Result<Mask, MaskImageError> {
    let pixels = MaskPixels::of(decoded);
    let mut values = pixels.values(|p| p[3] * brightness(p));
    if values.low == values.high {
        let alpha = pixels.values(|p| TOP * p[3]);
        if alpha.low == alpha.high {
            return values.constant(lossy);
        }
        values = alpha;
    } else if pixels.coloured(&values) > COLOURED {
        return Err(MaskImageError::Coloured);
    }
    if values.range() < NARROW && (lossy || !values.two_valued()) {
        return values.narrow(lossy);
    }
    if !values.two_valued() {
        values.soft(lossy)?;
    }
    Ok(values.over_the_middle())
}

fn brightness([r, g, b, _]: [f32; 4]) -> f32 {
    // Exact where it is grey.
    if r == g && g == b { r } else { 0.2126 * r + 0.7152 * g + 0.0722 * b }
}

/// One value per pixel, 0 to 65535.
struct Values {
    width: usize,
    height: usize,
    values: Vec<u16>,
    low: u16,
    high: u16,
    /// The step between two values of the file.
    step: u16,
}

impl Values {
    fn range(&self) -> f32 {
        f32::from(self.high - self.low)
    }

    fn two_valued(&self) -> bool {
        self.values.iter().all(|&v| v == self.low || v == self.high)
    }

    fn over_the_middle(&self) -> Mask {
        let middle = (u32::from(self.low) + u32::from(self.high)) / 2;
        let (w, h) = (self.width as u32, self.height as u32);
        Mask::from_fn(w, h, |x, y| u32::from(self.values[y as usize * self.width + x as usize]) > middle)
    }

    fn empty(&self) -> Mask {
        Mask::empty(self.width as u32, self.height as u32)
    }

    fn full(&self) -> Mask {
        Mask::full(self.width as u32, self.height as u32)
    }

    /// A mask of one value.
    fn constant(&self, lossy: bool) -> Result<Mask, MaskImageError> {
        match self.low {
            0 => Ok(self.empty()),
            _ if lossy => self.narrow(lossy),
            v if f32::from(v) == TOP || v == self.step => Ok(self.full()),
            v => Err(MaskImageError::OneGrey { grey: v / self.step }),
        }
    }

    /// A mask whose values hardly differ. The decoder of a black JPEG may give 1.
    fn narrow(&self, lossy: bool) -> Result<Mask, MaskImageError> {
        if lossy && f32::from(self.high) < 2.0 * NARROW {
            return Ok(self.empty());
        }
        if lossy && f32::from(self.low) > TOP - 2.0 * NARROW {
            return Ok(self.full());
        }
        let (low, high) = (self.low / self.step, self.high / self.step);
        Err(if lossy {
            MaskImageError::LossyGrey { low, high }
        } else {
            MaskImageError::Numbers { low, high }
        })
    }

    /// Whether there are so few values that each may be the number of a region; soft edges have many.
    fn are_numbers(&self) -> bool {
        let mut seen = std::collections::BTreeSet::new();
        self.values.iter().all(|&v| seen.contains(&v) || (seen.insert(v) && seen.len() <= NUMBERS))
    }

    /// Refuses an image that is not two values with soft edges.
    fn soft(&self, lossy: bool) -> Result<(), MaskImageError> {
        let numbers = !lossy && self.are_numbers();
        let is_middle = |v: u16| {
            let at = f32::from(v - self.low) / self.range();
            at > END && at < 1.0 - END
        };
        let (w, n) = (self.width, self.values.len() as f64);
        let amid = self.values.iter().filter(|&&v| is_middle(v)).count() as f64;
        if amid > (1.0 - TWO_VALUED) * n {
            return Err(MaskImageError::Photo { percent: 100.0 * amid / n });
        }
        let flat = |&i: &usize| {
            let (x, v) = (i % w, self.values[i]);
            let alike = |j: usize| self.values.get(j).is_some_and(|&u| u == v);
            let third = if numbers { v != self.low && v != self.high } else { is_middle(v) };
            third && x > 0 && x + 1 < w && i >= w && [i - 1, i + 1, i - w, i + w].into_iter().all(alike)
        };
        let flat = (0..self.values.len()).filter(flat).count() as f64;
        if flat > FLAT * n {
            return Err(MaskImageError::Regions { percent: 100.0 * flat / n });
        }
        Ok(())
    }
}

/// The samples of an image, whatever its depth.
enum MaskSamples<'a> {
    Bytes(&'a [u8]),
    Words(&'a [u16]),
    Floats(&'a [f32]),
}

struct MaskPixels<'a> {
    samples: MaskSamples<'a>,
    channels: usize,
    width: usize,
    height: usize,
}

impl MaskPixels<'_> {
    fn of(decoded: &DynamicImage) -> MaskPixels<'_> {
        let samples = if let Some(s) = decoded.as_flat_samples_u8() {
            MaskSamples::Bytes(s.samples)
        } else if let Some(s) = decoded.as_flat_samples_u16() {
            MaskSamples::Words(s.samples)
        } else {
            MaskSamples::Floats(decoded.as_flat_samples_f32().map_or(&[], |s| s.samples))
        };
        let channels = usize::from(decoded.color().channel_count());
        MaskPixels { samples, channels, width: decoded.width() as usize, height: decoded.height() as usize }
    }

    /// A sample, 0 to 65535.
    fn sample(&self, k: usize) -> f32 {
        match self.samples {
            MaskSamples::Bytes(s) => f32::from(s[k]) * 257.0,
            MaskSamples::Words(s) => f32::from(s[k]),
            // Floats may be anything.
            MaskSamples::Floats(s) => {
                s.get(k).filter(|v| v.is_finite()).map_or(0.0, |v| v.clamp(0.0, 1.0) * TOP)
            }
        }
    }

    /// Red, green and blue of a pixel, 0 to 65535, and its alpha, 0 to 1.
    fn at(&self, i: usize) -> [f32; 4] {
        let s = |c: usize| self.sample(self.channels * i + c);
        match self.channels {
            1 => [s(0), s(0), s(0), 1.0],
            2 => [s(0), s(0), s(0), s(1) / TOP],
            3 => [s(0), s(1), s(2), 1.0],
            _ => [s(0), s(1), s(2), s(3) / TOP],
        }
    }

    /// A value of each pixel, 0 to 65535.
    fn values(&self, of: impl Fn([f32; 4]) -> f32) -> Values {
        let n = self.width * self.height;
        let values: Vec<u16> = (0..n).map(|i| of(self.at(i)).round() as u16).collect();
        let low = values.iter().copied().min().unwrap_or(0);
        let high = values.iter().copied().max().unwrap_or(0);
        let step = if matches!(self.samples, MaskSamples::Bytes(_)) { 257 } else { 1 };
        Values { width: self.width, height: self.height, values, low, high, step }
    }

    /// Share of the pixels whose colour does not lie between those of the darkest and the brightest pixel.
    fn coloured(&self, values: &Values) -> f64 {
        if self.channels < 3 {
            return 0.0;
        }
        // What is transparent has no colour.
        let colour = |i: usize| {
            let [r, g, b, a] = self.at(i);
            [a * r, a * g, a * b]
        };
        let first = |v: u16| colour(values.values.iter().position(|&u| u == v).unwrap_or(0));
        let (dark, bright) = (first(values.low), first(values.high));
        let off = |&i: &usize| {
            let (t, p) = (f32::from(values.values[i] - values.low) / values.range(), colour(i));
            (0..3).any(|c| (dark[c] + t * (bright[c] - dark[c]) - p[c]).abs() > TOP / 8.0)
        };
        let n = values.values.len();
        (0..n).filter(off).count() as f64 / n.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ExtendedColorType as Colour, ImageEncoder};

    const SIZE: u32 = 40;

    fn inside(x: u32, y: u32) -> bool {
        (10..30).contains(&x) && (5..35).contains(&y)
    }

    fn file(name: &str, colour: Colour, pixel: impl Fn(u32, u32) -> Vec<u8>) -> Result<Mask, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(name);
        let bytes: Vec<u8> = (0..SIZE * SIZE).flat_map(|i| pixel(i % SIZE, i / SIZE)).collect();
        let out = std::fs::File::create(&path).unwrap();
        if name.ends_with("png") {
            image::codecs::png::PngEncoder::new(out).write_image(&bytes, SIZE, SIZE, colour).unwrap();
        } else {
            image::codecs::jpeg::JpegEncoder::new_with_quality(out, 70)
                .write_image(&bytes, SIZE, SIZE, colour)
                .unwrap();
        }
        Mask::read_png(&path).map_err(|e| e.to_string())
    }

    fn grey(value: impl Fn(u32, u32) -> u8) -> Result<Mask, String> {
        file("a.png", Colour::L8, |x, y| vec![value(x, y)])
    }

    #[test]
    fn an_object_of_1_beside_a_void_of_255_is_refused_and_not_lost() {
        let message = grey(|x, y| if inside(x, y) { 1 } else { 255 * u8::from(x < 12) }).unwrap_err();
        assert!(message.contains("third value"), "{message}");
    }

    #[test]
    fn a_mask_of_any_two_values_is_the_same_mask() {
        let wanted = Mask::from_fn(SIZE, SIZE, inside);
        let two = |out: u8, into: u8| move |x, y| if inside(x, y) { into } else { out };
        for (out, into) in [(0, 255), (0, 1), (0, 128), (100, 200), (254, 255)] {
            assert_eq!(grey(two(out, into)), Ok(wanted.clone()), "{out} and {into}");
        }
        let deep = |into: u16| move |x, y| if inside(x, y) { into } else { 0 }.to_ne_bytes().to_vec();
        for into in [1, 255, 65535] {
            assert_eq!(file("a.png", Colour::L16, deep(into)), Ok(wanted.clone()), "16 bit, {into}");
        }
        // A palette's colours; RGBA that is opaque; alpha alone, over black and over white.
        let colour = |x, y| if inside(x, y) { vec![128, 0, 0] } else { vec![0, 0, 0] };
        assert_eq!(file("a.png", Colour::Rgb8, colour), Ok(wanted.clone()));
        for (out, into) in
            [([0, 0, 0, 255], [255; 4]), ([0; 4], [0, 0, 0, 255]), ([255, 255, 255, 0], [255; 4])]
        {
            let pixel = |x, y| if inside(x, y) { into } else { out }.to_vec();
            assert_eq!(file("a.png", Colour::Rgba8, pixel), Ok(wanted.clone()), "{out:?} and {into:?}");
        }
    }

    #[test]
    fn soft_edges_and_the_ringing_of_jpeg_are_no_harm() {
        let wanted = Mask::from_fn(SIZE, SIZE, inside);
        let jpeg = |x, y| vec![if inside(x, y) { 255 } else { 0 }];
        assert!(file("a.jpg", Colour::L8, jpeg).unwrap().iou(&wanted) > 0.97);
        let soft = grey(|x, y| match (inside(x, y), x == 10 || x == 29) {
            (true, true) => 150 + (y as u8 % 20),
            (inside, _) => 255 * u8::from(inside),
        });
        assert_eq!(soft, Ok(wanted));
        for (value, mask) in [(0, Mask::empty(SIZE, SIZE)), (255, Mask::full(SIZE, SIZE))] {
            assert_eq!(file("a.jpg", Colour::L8, |_, _| vec![value]), Ok(mask));
        }
    }

    #[test]
    fn a_mask_of_one_value_means_nothing_or_everything() {
        assert_eq!(grey(|_, _| 0), Ok(Mask::empty(SIZE, SIZE)));
        assert_eq!(
            (grey(|_, _| 1), grey(|_, _| 255)),
            (Ok(Mask::full(SIZE, SIZE)), Ok(Mask::full(SIZE, SIZE)))
        );
        assert!(grey(|_, _| 90).unwrap_err().contains("one grey (90)"));
        assert_eq!(file("a.png", Colour::Rgba8, |_, _| vec![0, 0, 0, 255]), Ok(Mask::empty(SIZE, SIZE)));
    }

    #[test]
    fn photos_and_numbered_regions_are_no_masks() {
        let wave = |x: u32, y: u32, k: f32| (128.0 + 120.0 * (0.3 * x as f32 + k * y as f32).sin()) as u8;
        let photo =
            file("a.png", Colour::Rgb8, |x, y| vec![wave(x, y, 0.1), wave(x, y, 0.7), wave(y, x, 0.3)]);
        assert!(photo.unwrap_err().contains("many colours"));
        assert!(grey(|x, y| wave(x, y, 0.2)).unwrap_err().contains("photo"));
        assert!(grey(|x, _| (x / 10) as u8).unwrap_err().contains("0 to 3"), "numbered regions");
        let third = grey(|x, y| if x < 8 && y < 8 { 120 } else { 255 * u8::from(inside(x, y)) });
        assert!(third.unwrap_err().contains("third value"));
    }
}
