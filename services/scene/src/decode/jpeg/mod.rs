//! JPEGs: their heads, checks that their data are whole, and decoding to a smaller size.
//!
//! Photos of a usual size are decoded by `zune-jpeg`, whole. Of a large one only so many coefficients per block are
//! transformed as the target size needs, so that neither the whole image nor, where it is progressive, its whole
//! coefficients are ever in memory. The same walk through the blocks tells whether the data are damaged, which decoders do not
//! say: they fill with grey.

mod bits;
mod block;
mod head;
mod progressive;
mod scan;
#[cfg(test)]
mod tests;

pub(crate) use head::{Coding, JpegFrame, JpegHead, read};
pub(crate) use scan::ScanResult;

use super::DecodeError;
use block::{BlockSink, CoefficientBlock};
use image::{DynamicImage, GrayImage, RgbImage};

/// Looks for damage; `None` where the JPEG is coded in a way that is not known here.
pub(crate) fn check(bytes: &[u8], frame: &JpegFrame) -> Option<ScanResult> {
    struct Nothing;
    impl BlockSink for Nothing {
        fn wanted(&self, _: usize) -> (usize, usize) {
            (0, 0)
        }
        fn block(&mut self, _: usize, _: (usize, usize), _: &CoefficientBlock, _: &[u16; 64]) {}
    }
    scan::walk(bytes, frame, &mut Nothing)
}

const NO_SIZE: DecodeError = DecodeError::Malformed("the JPEG has no size");

/// Decodes the whole image.
pub(crate) fn whole(bytes: &[u8]) -> Result<DynamicImage, DecodeError> {
    use zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions};
    let options =
        DecoderOptions::default().set_strict_mode(false).set_max_width(usize::MAX).set_max_height(usize::MAX);
    let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(DecodeError::Jpeg)?;
    let grey = decoder.input_colorspace() == Some(ColorSpace::Luma);
    let colours = if grey { ColorSpace::Luma } else { ColorSpace::RGB };
    let options = options.jpeg_set_out_colorspace(colours);
    let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    let pixels = decoder.decode().map_err(DecodeError::Jpeg)?;
    let (width, height) = decoder.dimensions().ok_or(NO_SIZE)?;
    let (width, height) = (width as u32, height as u32);
    let image = match grey {
        true => GrayImage::from_raw(width, height, pixels).map(DynamicImage::from),
        false => RgbImage::from_raw(width, height, pixels).map(DynamicImage::from),
    };
    image.ok_or(DecodeError::Malformed("the JPEG has too few pixels"))
}

impl JpegFrame {
    /// Pixels per block of the image at the size that is at least `least` x `least_height`: 8, 4, 2 or 1.
    pub fn scale_for(&self, least: (f64, f64)) -> usize {
        let enough = |n: &usize| {
            let n = *n as f64 / 8.0;
            self.width as f64 * n >= least.0 && self.height as f64 * n >= least.1
        };
        [1, 2, 4].into_iter().find(enough).unwrap_or(8)
    }

    /// Whether [`scaled`] decodes it.
    pub fn scales(&self) -> bool {
        self.coding != Coding::Other && matches!(self.components.len(), 1 | 3)
    }

    /// Pixels per block of a component, across and down: where it is sampled less it is transformed to more.
    fn block_size(&self, component: usize, scale: usize) -> (usize, usize) {
        let (c, (most_h, most_v)) = (self.components[component], self.most());
        let size = |own: usize, most: usize| match scale * most / own {
            n @ (1 | 2 | 4 | 8) if (scale * most).is_multiple_of(own) => n,
            _ => scale,
        };
        (size(c.h, most_h), size(c.v, most_v))
    }

    /// Bytes that [`scaled`] takes beside the file's.
    pub fn scaled_bytes(&self, scale: usize) -> u64 {
        let sizes: Vec<_> = (0..self.components.len()).map(|c| self.block_size(c, scale)).collect();
        let (x, y) = self.units();
        let blocks = |c: usize| (x * self.components[c].h * y * self.components[c].v) as u64;
        let planes: u64 = sizes.iter().enumerate().map(|(c, s)| blocks(c) * (s.0 * s.1) as u64).sum();
        let kept = if self.coding == Coding::Progressive { progressive::bytes(self, &sizes) } else { 0 };
        let image_bytes = 3 * ((self.width * scale / 8 + 1) * (self.height * scale / 8 + 1)) as u64;
        planes + kept + image_bytes
    }
}

/// The inverse cosine transform of the `n` lowest of eight coefficients to `n` pixels, by coefficient and pixel.
fn waves(n: usize) -> [[f32; 8]; 8] {
    let wave = |k: usize, x: usize| {
        let c = if k == 0 { std::f64::consts::FRAC_1_SQRT_2 } else { 1.0 };
        let angle = (2 * x + 1) as f64 * k as f64 * std::f64::consts::PI / (2 * n) as f64;
        (0.5 * c * angle.cos()) as f32
    };
    std::array::from_fn(|k| std::array::from_fn(|x| if x < n && k < n { wave(k, x) } else { 0.0 }))
}

/// A component's samples at the smaller size.
struct ComponentPlane {
    /// Samples of a block, across and down.
    size: (usize, usize),
    waves: ([[f32; 8]; 8], [[f32; 8]; 8]),
    stride: usize,
    samples: Vec<u8>,
}

impl ComponentPlane {
    fn put(&mut self, at: (usize, usize), block: &CoefficientBlock, table: &[u16; 64]) {
        match self.size.0 {
            1 => self.transform::<1>(at, block, table),
            2 => self.transform::<2>(at, block, table),
            4 => self.transform::<4>(at, block, table),
            _ => self.transform::<8>(at, block, table),
        }
    }

    /// Transforms a block to `W` samples across, which the compiler knows, so that it computes several at once.
    fn transform<const W: usize>(
        &mut self,
        (x, y): (usize, usize),
        block: &CoefficientBlock,
        table: &[u16; 64],
    ) {
        let h = self.size.1;
        // Rows first: `half[v]` of coefficient row v. Rows after the last that is not all zero add nothing.
        let mut half = [[0f32; W]; 8];
        let mut filled = 0;
        for (v, line) in half.iter_mut().enumerate().take(h) {
            let (values, steps) = (&block[8 * v..8 * v + W], &table[8 * v..8 * v + W]);
            if values.iter().fold(0, |any, value| any | value) == 0 {
                continue;
            }
            filled = v + 1;
            for ((value, step), wave) in values.iter().zip(steps).zip(&self.waves.0) {
                let value = f32::from(*value) * f32::from(*step);
                for (sum, wave) in line.iter_mut().zip(wave) {
                    *sum += value * wave;
                }
            }
        }
        for row in 0..h {
            let mut sums = [0f32; W];
            for (line, wave) in half[..filled].iter().zip(&self.waves.1) {
                for (sum, value) in sums.iter_mut().zip(line) {
                    *sum += value * wave[row];
                }
            }
            let first = (y * h + row) * self.stride + x * W;
            for (sample, sum) in self.samples[first..first + W].iter_mut().zip(sums) {
                *sample = (sum + 128.5).clamp(0.0, 255.0) as u8;
            }
        }
    }
}

impl BlockSink for Vec<ComponentPlane> {
    fn wanted(&self, component: usize) -> (usize, usize) {
        self[component].size
    }

    fn block(&mut self, component: usize, at: (usize, usize), block: &CoefficientBlock, table: &[u16; 64]) {
        self[component].put(at, block, table);
    }
}

/// Decodes the image with `scale` of each 8 pixels, across and down; how many columns and rows of what comes back it fills, for
/// the last ones may be filled in part.
///
/// # Errors
/// Its data are damaged, or its coding is not known here.
pub(crate) fn scaled(
    bytes: &[u8],
    frame: &JpegFrame,
    scale: usize,
) -> Result<(DynamicImage, [f64; 2]), DecodeError> {
    let (units_x, units_y) = frame.units();
    let plane = |c: usize| {
        let (size, part) = (frame.block_size(c, scale), frame.components[c]);
        let (stride, rows) = (units_x * part.h * size.0, units_y * part.v * size.1);
        ComponentPlane {
            size,
            waves: (waves(size.0), waves(size.1)),
            stride,
            samples: vec![0; stride * rows],
        }
    };
    let mut planes: Vec<ComponentPlane> = (0..frame.components.len()).map(plane).collect();
    let found = scan::walk(bytes, frame, &mut planes);
    let found = found.ok_or(DecodeError::Malformed("its coding is not known"))?;
    if let Some(damage) = found.damage(bytes.len() as u64) {
        return Err(damage);
    }
    let extent = [frame.width, frame.height].map(|n| n as f64 * scale as f64 / 8.0);
    let (width, height) = (extent[0].ceil() as usize, extent[1].ceil() as usize);
    let (most_h, most_v) = frame.most();
    let row = |c: usize, y: usize| {
        let (part, plane) = (frame.components[c], &planes[c]);
        let at = y * part.v * plane.size.1 / (most_v * scale);
        &plane.samples[at * plane.stride..][..plane.stride]
    };
    if planes.len() == 1 {
        let pixels: Vec<u8> = (0..height).flat_map(|y| row(0, y)[..width].iter().copied()).collect();
        let image = GrayImage::from_raw(width as u32, height as u32, pixels);
        return Ok((image.ok_or(NO_SIZE)?.into(), extent));
    }
    let rgb = frame.is_rgb(bytes);
    let mut pixels = vec![0; 3 * width * height];
    let mut lines: [Vec<u8>; 3] = std::array::from_fn(|_| vec![0; width]);
    for y in 0..height {
        for (c, line) in lines.iter_mut().enumerate() {
            let (samples, step, of) = (row(c, y), frame.components[c].h * planes[c].size.0, most_h * scale);
            if step == of {
                line.copy_from_slice(&samples[..width]);
            } else {
                // Where a component cannot be transformed to the image's size, its samples repeat.
                line.iter_mut().enumerate().for_each(|(x, sample)| *sample = samples[x * step / of]);
            }
        }
        let [first, second, third] = &lines;
        let values = first.iter().zip(second).zip(third).map(|((&a, &b), &c)| [a, b, c]);
        let pixels = pixels[3 * width * y..][..3 * width].chunks_exact_mut(3).zip(values);
        match rgb {
            true => pixels.for_each(|(pixel, value)| pixel.copy_from_slice(&value)),
            false => pixels.for_each(|(pixel, value)| pixel.copy_from_slice(&colour(value))),
        }
    }
    let image = RgbImage::from_raw(width as u32, height as u32, pixels);
    Ok((image.ok_or(NO_SIZE)?.into(), extent))
}

/// From luma and chroma, BT.601 at full range.
fn colour([y, cb, cr]: [u8; 3]) -> [u8; 3] {
    let (y, cb, cr) = (f32::from(y), f32::from(cb) - 128.0, f32::from(cr) - 128.0);
    [y + 1.402 * cr, y - 0.344_136 * cb - 0.714_136 * cr, y + 1.772 * cb]
        .map(|v| (v + 0.5).clamp(0.0, 255.0) as u8)
}

impl JpegFrame {
    /// Whether three components are red, green and blue: an Adobe segment says so.
    fn is_rgb(&self, bytes: &[u8]) -> bool {
        const ADOBE: &[u8] = b"\xff\xee\x00\x0eAdobe";
        let start = &bytes[..bytes.len().min(1 << 16)];
        let adobe = start.windows(ADOBE.len()).position(|w| w == ADOBE);
        let transform = adobe.and_then(|at| start.get(at + 15));
        let ids: Vec<u8> = self.components.iter().map(|c| c.id).collect();
        transform == Some(&0) || (transform.is_none() && ids == *b"RGB")
    }
}

/// Bytes of data, and share of all, that may be left over without harm: some cameras pad.
const UNUSED: (u64, f64) = (64, 1e-3);

impl ScanResult {
    /// Why the photo is not to be used, if so.
    pub fn damage(&self, bytes: u64) -> Option<DecodeError> {
        let percent = (100.0 * self.good).floor();
        if self.short {
            return Some(DecodeError::CutShort { percent });
        }
        if self.broken {
            return Some(DecodeError::Broken { percent });
        }
        (self.left > UNUSED.0 && self.left as f64 > UNUSED.1 * bytes as f64)
            .then_some(DecodeError::LeftOver { bytes: self.left })
    }

    /// What to say of a photo that can be used.
    pub fn oddity(&self, ended: bool) -> Option<String> {
        match (ended, self.left) {
            (false, _) => {
                Some("the JPEG has no end marker; all of its image is there, and it is used".into())
            }
            (true, 0..4) => None,
            (true, left) => Some(format!(
                "{left} bytes of its data belong to no part of the image; it is used, but look at it: the file may be damaged"
            )),
        }
    }
}
