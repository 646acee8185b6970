//! PNGs, read row by row: large ones shrink while they are read.

use super::DecodeError;
use image::{DynamicImage, ImageBuffer, Luma, LumaA, Pixel, Rgb, Rgba};
use png::{BitDepth, ColorType, Transformations};
use std::fs::File;
use std::io::BufReader;

/// Bytes that chunks beside the image's, and the rows at work, may take.
const SIDE: usize = 16 << 20;

/// The head of a PNG.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PngHead {
    pub width: u32,
    pub height: u32,
    pub interlaced: bool,
    /// Channels as decoded, palettes and transparent colours resolved, and bytes of each.
    pub channels: usize,
    pub depth: usize,
    /// Bits of a pixel as stored.
    pub bits: usize,
}

type PngReader = png::Reader<BufReader<File>>;

/// Text and colour profiles are of no use here and may unpack to any size: they are passed over.
fn decoder(file: File) -> png::Decoder<BufReader<File>> {
    let mut decoder = png::Decoder::new_with_limits(BufReader::new(file), png::Limits { bytes: SIDE });
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    // Palettes and less than 8 bits become bytes; 16 bits stay.
    decoder.set_transformations(Transformations::EXPAND);
    decoder
}

/// Width and height; nothing after them is read.
pub(crate) fn size(file: File) -> Result<(u32, u32), DecodeError> {
    let mut decoder = decoder(file);
    let info = decoder.read_header_info().map_err(DecodeError::Png)?;
    Ok((info.width, info.height))
}

/// Reads up to the image's data: the head and the EXIF data.
pub(crate) fn head(file: File) -> Result<(PngHead, Option<Vec<u8>>), DecodeError> {
    let reader = decoder(file).read_info().map_err(DecodeError::Png)?;
    let exif = reader.info().exif_metadata.as_ref().map(|exif| exif.to_vec());
    Ok((of(&reader), exif))
}

fn of(reader: &PngReader) -> PngHead {
    let (colour, depth) = reader.output_color_type();
    let depth = if depth == BitDepth::Sixteen { 2 } else { 1 };
    let info = reader.info();
    PngHead {
        width: info.width,
        height: info.height,
        interlaced: info.interlaced,
        channels: colour.samples(),
        depth,
        bits: info.bits_per_pixel(),
    }
}

/// Decodes the whole image.
pub(crate) fn whole(file: File) -> Result<DynamicImage, DecodeError> {
    let mut reader = decoder(file).read_info().map_err(DecodeError::Png)?;
    let head = of(&reader);
    let size = reader.output_buffer_size().ok_or(DecodeError::Malformed("the PNG is too large"))?;
    let mut bytes = vec![0; size];
    reader.next_frame(&mut bytes).map_err(DecodeError::Png)?;
    let colour = reader.output_color_type().0;
    if head.depth == 1 {
        return image_of(colour, head.width, head.height, bytes);
    }
    let wide = bytes.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect();
    image_of_wide(colour, head.width, head.height, wide)
}

/// How many pixels of a side become one, so that at least `least` are left.
pub(crate) fn step(head: &PngHead, least: (f64, f64)) -> usize {
    let across = f64::from(head.width) / least.0.max(1.0);
    let down = f64::from(head.height) / least.1.max(1.0);
    if head.interlaced { 1 } else { (across.min(down) as usize).max(1) }
}

/// Decodes the image with each `step` x `step` pixels as their mean; how many columns and rows of what comes back it fills.
pub(crate) fn scaled(file: File, step: usize) -> Result<(DynamicImage, [f64; 2]), DecodeError> {
    let mut reader = decoder(file).read_info().map_err(DecodeError::Png)?;
    let head = of(&reader);
    let colour = reader.output_color_type().0;
    let (width, height) = (head.width as usize, head.height as usize);
    let (to_width, to_height) = (width.div_ceil(step), height.div_ceil(step));
    let values = to_width * head.channels;
    let mut out: Vec<u16> = Vec::with_capacity(values * to_height);
    let mut sums = vec![0u64; values];
    for y in 0..height {
        let row = reader.next_row().map_err(DecodeError::Png)?;
        let row = row.ok_or(DecodeError::Malformed("the PNG has too few rows"))?;
        add(&mut sums, row.data(), &head, step);
        let rows = y % step + 1;
        if rows == step || y + 1 == height {
            for (i, sum) in sums.iter_mut().enumerate() {
                let columns = step.min(width - i / head.channels * step);
                let n = (rows * columns) as u64;
                out.push(((*sum + n / 2) / n) as u16);
                *sum = 0;
            }
        }
    }
    // The end of the data, and whether they are whole.
    reader.next_row().map_err(DecodeError::Png)?;
    let extent = [width, height].map(|n| n as f64 / step as f64);
    let (w, h) = (to_width as u32, to_height as u32);
    let image = match head.depth {
        1 => image_of(colour, w, h, out.iter().map(|&v| v as u8).collect())?,
        _ => image_of_wide(colour, w, h, out)?,
    };
    Ok((image, extent))
}

/// Adds a row to the sums of its pixels' groups.
fn add(sums: &mut [u64], row: &[u8], head: &PngHead, step: usize) {
    let n = head.channels;
    let groups = sums.chunks_exact_mut(n).zip(row.chunks(n * head.depth * step));
    for (sums, group) in groups {
        for pixel in group.chunks_exact(n * head.depth) {
            for (sum, value) in sums.iter_mut().zip(pixel.chunks_exact(head.depth)) {
                *sum += value.iter().fold(0, |v, &byte| v << 8 | u64::from(byte));
            }
        }
    }
}

fn image_of(colour: ColorType, width: u32, height: u32, bytes: Vec<u8>) -> Result<DynamicImage, DecodeError> {
    fn of<P: Pixel<Subpixel = u8>>(w: u32, h: u32, bytes: Vec<u8>) -> Option<DynamicImage>
    where
        DynamicImage: From<ImageBuffer<P, Vec<u8>>>,
    {
        ImageBuffer::<P, _>::from_raw(w, h, bytes).map(DynamicImage::from)
    }
    let image = match colour {
        ColorType::Grayscale => of::<Luma<u8>>(width, height, bytes),
        ColorType::GrayscaleAlpha => of::<LumaA<u8>>(width, height, bytes),
        ColorType::Rgb => of::<Rgb<u8>>(width, height, bytes),
        ColorType::Rgba => of::<Rgba<u8>>(width, height, bytes),
        ColorType::Indexed => None,
    };
    image.ok_or(DecodeError::Malformed("the PNG's colours are not known"))
}

fn image_of_wide(
    colour: ColorType,
    width: u32,
    height: u32,
    values: Vec<u16>,
) -> Result<DynamicImage, DecodeError> {
    fn of<P: Pixel<Subpixel = u16>>(w: u32, h: u32, values: Vec<u16>) -> Option<DynamicImage>
    where
        DynamicImage: From<ImageBuffer<P, Vec<u16>>>,
    {
        ImageBuffer::<P, _>::from_raw(w, h, values).map(DynamicImage::from)
    }
    let image = match colour {
        ColorType::Grayscale => of::<Luma<u16>>(width, height, values),
        ColorType::GrayscaleAlpha => of::<LumaA<u16>>(width, height, values),
        ColorType::Rgb => of::<Rgb<u16>>(width, height, values),
        ColorType::Rgba => of::<Rgba<u16>>(width, height, values),
        ColorType::Indexed => None,
    };
    image.ok_or(DecodeError::Malformed("the PNG's colours are not known"))
}
