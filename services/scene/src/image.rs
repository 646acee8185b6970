//! Planar float images.

use crate::whole::read_whole;
use crate::{SceneError, decode};
use std::path::Path;
use wincode::SchemaWrite;

/// A planar f32 image: `data[(c * height + y) * width + x]`. Colours are sRGB values in [0, 1].
///
/// Planar, because the kernels run SIMD over pixels of one channel.
#[derive(Clone, Debug, PartialEq, SchemaWrite)]
pub struct Image {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Number of planes.
    pub channels: usize,
    /// Planes one after another, each row-major; length `channels * height * width`.
    pub data: Vec<f32>,
}

read_whole!(
    Image as ImageRecord { width: usize, height: usize, channels: usize, data: Vec<f32> }
    where |image| fills(&image.data, [image.width, image.height, image.channels]),
    "an image has another number of pixels"
);

/// Whether there is one value for each of so many.
pub(crate) fn fills(data: &[f32], counts: [usize; 3]) -> bool {
    counts.into_iter().try_fold(1usize, usize::checked_mul) == Some(data.len())
}

impl Image {
    /// An image of zeros.
    pub fn zeros(width: usize, height: usize, channels: usize) -> Image {
        Image::filled(width, height, channels, 0.0)
    }

    /// An image of one value.
    pub fn filled(width: usize, height: usize, channels: usize, value: f32) -> Image {
        Image { width, height, channels, data: vec![value; width * height * channels] }
    }

    /// Pixels per plane.
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// One plane.
    pub fn plane(&self, channel: usize) -> &[f32] {
        let n = self.pixels();
        &self.data[channel * n..(channel + 1) * n]
    }

    /// One plane, writable.
    pub fn plane_mut(&mut self, channel: usize) -> &mut [f32] {
        let n = self.pixels();
        &mut self.data[channel * n..(channel + 1) * n]
    }

    /// Value at a pixel.
    pub fn at(&self, channel: usize, x: usize, y: usize) -> f32 {
        self.data[(channel * self.height + y) * self.width + x]
    }

    /// The image at another size: where it shrinks, each pixel is the mean over the area it covers; where it
    /// grows, linear between pixel centres. Values never leave the range they were in.
    pub fn resized(&self, width: usize, height: usize) -> Image {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let (columns, rows) = (resize_taps(self.width, width), resize_taps(self.height, height));
        let mut out = Image::zeros(width, height, self.channels);
        let mut line = vec![0.0f32; self.width];
        for c in 0..self.channels {
            for (y, row) in rows.iter().enumerate() {
                line.fill(0.0);
                for (k, weight) in row.weights.iter().enumerate() {
                    let from = &self.plane(c)[(row.first + k) * self.width..][..self.width];
                    for (sum, value) in line.iter_mut().zip(from) {
                        *sum += weight * value;
                    }
                }
                let to = &mut out.plane_mut(c)[y * width..][..width];
                for (value, column) in to.iter_mut().zip(&columns) {
                    *value = column.weights.iter().zip(&line[column.first..]).map(|(w, v)| w * v).sum();
                }
            }
        }
        out
    }

    /// Reads a PNG or JPEG file as three planes in [0, 1]; no EXIF orientation is applied, alpha is dropped.
    pub fn read(path: &Path) -> Result<Image, SceneError> {
        let rgb = read_file(path)?.into_rgb32f();
        let mut out = Image::zeros(rgb.width() as usize, rgb.height() as usize, 3);
        let n = out.pixels();
        for (i, pixel) in rgb.pixels().enumerate() {
            for c in 0..3 {
                out.data[c * n + i] = pixel.0[c];
            }
        }
        Ok(out)
    }

    /// Writes one plane as grey or three as RGB, 8 bits: values are clamped to [0, 1] and rounded; a NaN is black.
    ///
    /// # Panics
    /// When the image has neither one nor three planes.
    pub fn write_png(&self, path: &Path) -> Result<(), SceneError> {
        let (bytes, colour) = self.bytes();
        write_png(path, &bytes, self.width, self.height, colour)
    }

    /// The image as a JPEG file of a quality from 1 to 100; values as in [`Image::write_png`].
    ///
    /// ```
    /// let grey = segwild_scene::Image::filled(16, 8, 3, 0.5);
    /// assert!(grey.to_jpeg(85).starts_with(&[0xff, 0xd8]));
    /// ```
    ///
    /// # Panics
    /// When the image has neither one nor three planes, no pixel, or a side of more than 65,535.
    pub fn to_jpeg(&self, quality: u8) -> Vec<u8> {
        let (bytes, colour) = self.bytes();
        let mut out = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, quality)
            .encode(&bytes, self.width as u32, self.height as u32, colour)
            .expect("sides that JPEG can hold, and memory never refuses a byte");
        out
    }

    /// Bytes of each pixel, row by row, and what they are.
    fn bytes(&self) -> (Vec<u8>, image::ExtendedColorType) {
        assert!(
            self.channels == 1 || self.channels == 3,
            "an image has 1 or 3 planes, not {}",
            self.channels
        );
        let n = self.pixels();
        // `as u8` takes a NaN to 0.
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let bytes =
            (0..n).flat_map(|i| (0..self.channels).map(move |c| byte(self.data[c * n + i]))).collect();
        let colour =
            if self.channels == 1 { image::ExtendedColorType::L8 } else { image::ExtendedColorType::Rgb8 };
        (bytes, colour)
    }
}

/// Weights of the input pixels from `first` on that make one output pixel, along one axis.
struct ResizeTaps {
    first: usize,
    weights: Vec<f32>,
}

fn resize_taps(from: usize, to: usize) -> Vec<ResizeTaps> {
    let scale = from as f64 / to as f64;
    let one = |i: usize| {
        let (low, high) = if scale > 1.0 {
            (i as f64 * scale, (i + 1) as f64 * scale)
        } else {
            // Linear interpolation is the mean over one source pixel around the centre.
            let centre = (i as f64 + 0.5) * scale;
            (centre - 0.5, centre + 0.5)
        };
        let (low, high) = (low.max(0.0), high.min(from as f64));
        let first = (low.floor() as usize).min(from.saturating_sub(1));
        let last = (high.ceil() as usize).clamp(first + 1, from.max(first + 1));
        let cover = |k: usize| (high.min(k as f64 + 1.0) - low.max(k as f64)).max(0.0);
        let total: f64 = (first..last).map(cover).sum();
        ResizeTaps { first, weights: (first..last).map(|k| (cover(k) / total) as f32).collect() }
    };
    (0..to).map(one).collect()
}

/// Decodes a file whatever its name says it is.
pub(crate) fn read_file(path: &Path) -> Result<image::DynamicImage, SceneError> {
    read_file_within(path, decode::pixels_of(decode::MEGAPIXELS))
}

/// The same, of at most so many pixels.
pub(crate) fn read_file_within(path: &Path, most_pixels: u64) -> Result<image::DynamicImage, SceneError> {
    decode::open_file(path).map_err(SceneError::io(path))?;
    decode::decode_image(path, most_pixels).map_err(|e| SceneError::invalid(path, "image", e))
}

pub(crate) fn write_png(
    path: &Path,
    bytes: &[u8],
    width: usize,
    height: usize,
    colour: image::ExtendedColorType,
) -> Result<(), SceneError> {
    let out =
        png(bytes, width as u32, height as u32, colour).map_err(|e| SceneError::invalid(path, "image", e))?;
    Ok(segwild_files::write_atomic(path, &out)?)
}

/// Writes a render as a PNG with transparency, from its colours times their alpha, sRGB in [0, 1].
pub fn write_rgba(path: &Path, colours: &Image, alpha: &Image) -> Result<(), SceneError> {
    let n = colours.pixels();
    let byte = |v: f32| (255.0 * v).round().clamp(0.0, 255.0) as u8;
    let pixel = |i: usize| {
        let a = alpha.data[i];
        let colour = |c: usize| if a > 0.0 { byte(colours.data[c * n + i] / a) } else { 0 };
        [colour(0), colour(1), colour(2), byte(a)]
    };
    let bytes: Vec<u8> = (0..n).flat_map(pixel).collect();
    write_png(path, &bytes, colours.width, colours.height, image::ExtendedColorType::Rgba8)
}

/// The bytes of a PNG.
pub(crate) fn png(
    bytes: &[u8],
    width: u32,
    height: u32,
    colour: image::ExtendedColorType,
) -> image::ImageResult<Vec<u8>> {
    use image::ImageEncoder;
    let mut out = Vec::new();
    image::codecs::png::PngEncoder::new(&mut out).write_image(bytes, width, height, colour)?;
    Ok(out)
}
