//! Decoding of every image that somebody supplies: photos, masks, true masks.
//!
//! A file's format is recognised by its content, not by its name. The size of its image, and the memory that decoding it takes, are
//! known from its head before a pixel is decoded: [`ImageHead::read`] refuses an image over the bound, [`ImageHead::bytes_for`] gives the
//! memory of decoding, and [`limit_decoding`] bounds the memory of all threads together. Large photos shrink while they are decoded.

mod error;
mod exif;
mod foreign;
mod jpeg;
mod memory;
mod png;
mod tiff;
mod webp;

pub use error::DecodeError;
pub use exif::ExifCamera;
pub(crate) use foreign::{converted, converted_copies};
pub use memory::limit_decoding;
pub use segwild_files::open_plain as open_file;

use image::metadata::Orientation;
use image::{ColorType, DynamicImage, ImageDecoder, ImageFormat, ImageReader};
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

/// Default of the megapixels that an image may have.
pub(crate) const MEGAPIXELS: u32 = 200;
/// Images with more pixels are shrunk while they are decoded, where they are shrunk at all.
const LARGE: u64 = 4 << 20;
/// How many times the requested size the decoder leaves at the least: what is finer does the filter behind it.
const FINER: f64 = 2.0;
/// Most times that a PNG's deflated data can be larger once they are inflated.
const DEFLATE: u64 = 1032;
/// Most pixels that a byte of a BMP holds: its runs have at most 255 of them in two bytes.
const BMP_RUN: u64 = 128;

/// Most bytes of a file per pixel of the largest image that is allowed, beside [`LARGEST_REST`].
const LARGEST_PIXEL: u64 = 16;
/// Most bytes of a file beside its pixels.
const LARGEST_REST: u64 = 64 << 20;
/// More pixels than these are not counted for a file's size, even where any image is allowed.
const COUNTED: u64 = 1 << 32;

/// How a file is decoded.
#[derive(Clone, Debug, PartialEq)]
enum FileKind {
    Jpeg(jpeg::JpegHead),
    Png(png::PngHead),
    Other(ImageFormat, ColorType),
}

/// The head of an image file.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ImageHead {
    /// Size as stored.
    pub width: u32,
    pub height: u32,
    /// The EXIF orientation.
    pub orientation: Orientation,
    /// The EXIF data are of the other orientation, landscape or portrait: some program has turned the pixels since.
    pub turned_since: bool,
    /// The camera that took it, where EXIF data say so.
    pub camera: Option<ExifCamera>,
    kind: FileKind,
    /// Size of the file in bytes.
    file: u64,
}

/// A decoded image, perhaps at a smaller size.
pub(crate) struct Decoded {
    pub image: DynamicImage,
    /// Left, top, width and height of the part that the image fills, in pixels: the last column and row may be filled in part.
    pub part: [f64; 4],
}

impl Decoded {
    fn whole(image: DynamicImage) -> Decoded {
        let part = [0.0, 0.0, f64::from(image.width()), f64::from(image.height())];
        Decoded { image, part }
    }

    /// Turns it as an EXIF orientation says.
    pub fn turn(&mut self, orientation: Orientation) {
        let (w, h) = (f64::from(self.image.width()), f64::from(self.image.height()));
        let [l, t, pw, ph] = self.part;
        let (right, below) = (w - l - pw, h - t - ph);
        self.part = match orientation {
            Orientation::NoTransforms => [l, t, pw, ph],
            Orientation::Rotate90 => [below, l, ph, pw],
            Orientation::Rotate180 => [right, below, pw, ph],
            Orientation::Rotate270 => [t, right, ph, pw],
            Orientation::FlipHorizontal => [right, t, pw, ph],
            Orientation::FlipVertical => [l, below, pw, ph],
            Orientation::Rotate90FlipH => [t, l, ph, pw],
            Orientation::Rotate270FlipH => [below, right, ph, pw],
        };
        self.image.apply_orientation(orientation);
    }
}

/// Whether an EXIF orientation exchanges width and height.
pub(crate) fn swaps_sides(orientation: Orientation) -> bool {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    matches!(orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH)
}

/// Position in the stored image of the position `[u, v]` in the image turned by an EXIF orientation; both in shares of the
/// image's width and height, in [0, 1].
pub(crate) fn before_turn([u, v]: [f64; 2], orientation: Orientation) -> [f64; 2] {
    match orientation {
        Orientation::NoTransforms => [u, v],
        Orientation::Rotate90 => [v, 1.0 - u],
        Orientation::Rotate180 => [1.0 - u, 1.0 - v],
        Orientation::Rotate270 => [1.0 - v, u],
        Orientation::FlipHorizontal => [1.0 - u, v],
        Orientation::FlipVertical => [u, 1.0 - v],
        Orientation::Rotate90FlipH => [v, u],
        Orientation::Rotate270FlipH => [1.0 - v, 1.0 - u],
    }
}

impl ImageHead {
    /// Reads the head of a file whose image may have so many pixels; nothing is decoded.
    ///
    /// # Errors
    /// The system refuses the file, it is no image that is read, its head is damaged, or the image or the file is over the bound.
    pub fn read(path: &Path, most_pixels: u64) -> Result<ImageHead, DecodeError> {
        let mut file = open_file(path)?;
        let length = file.metadata()?.len();
        let mut start = Vec::new();
        file.by_ref().take(foreign::START as u64).read_to_end(&mut start)?;
        file.rewind()?;
        if start.is_empty() {
            return Err(DecodeError::Empty);
        }
        // A file of holes may claim terabytes, and to scan them would take hours.
        let most = LARGEST_PIXEL * most_pixels.min(COUNTED) + LARGEST_REST;
        if length > most {
            let too_large = DecodeError::TooLarge { bytes: length, most };
            return Err(foreign::refusal(path, &start).unwrap_or(too_large));
        }
        let head = match image::guess_format(&start) {
            Ok(ImageFormat::Jpeg) => ImageHead::of_jpeg(file, length)?,
            Ok(ImageFormat::Png) => ImageHead::of_png(path, file, length, most_pixels)?,
            Ok(format @ (ImageFormat::WebP | ImageFormat::Tiff | ImageFormat::Bmp)) => {
                foreign::refusal(path, &start).map_or(Ok(()), Err)?;
                ImageHead::of_other(file, length, format)?
            }
            _ => return Err(foreign::refusal(path, &start).unwrap_or(DecodeError::UnknownFormat)),
        };
        head.bounded(most_pixels)
    }

    fn bounded(self, most_pixels: u64) -> Result<ImageHead, DecodeError> {
        let ImageHead { width, height, .. } = self;
        within(width, height, most_pixels)?;
        // An image's data are never so much larger than its pixels.
        if let FileKind::Jpeg(jpeg) = &self.kind
            && jpeg.bytes > 16 * u64::from(width) * u64::from(height) + (16 << 20)
        {
            return Err(DecodeError::TooManyBytes { width, height, bytes: jpeg.bytes });
        }
        self.held_by_file()?;
        Ok(self)
    }

    /// Few bytes cannot hold the pixels of a large image: such a file would take memory for nothing.
    fn held_by_file(&self) -> Result<(), DecodeError> {
        let pixels = u64::from(self.width) * u64::from(self.height);
        let least = match &self.kind {
            FileKind::Png(png) => (pixels * png.bits as u64).div_ceil(8 * DEFLATE),
            FileKind::Other(ImageFormat::Bmp, _) => pixels.div_ceil(BMP_RUN),
            _ => 0,
        };
        if self.file >= least {
            return Ok(());
        }
        Err(DecodeError::TooFewBytes { width: self.width, height: self.height, bytes: self.file })
    }

    fn of_jpeg(file: File, length: u64) -> Result<ImageHead, DecodeError> {
        let jpeg = jpeg::read(BufReader::with_capacity(1 << 16, file))?;
        let (width, height) = (jpeg.frame.width as u32, jpeg.frame.height as u32);
        let exif = jpeg.exif.clone();
        Ok(ImageHead::new((width, height), exif.as_deref(), FileKind::Jpeg(jpeg), length))
    }

    fn of_png(path: &Path, file: File, length: u64, most_pixels: u64) -> Result<ImageHead, DecodeError> {
        let (width, height) = png::size(file)?;
        within(width, height, most_pixels)?;
        let (png, exif) = png::head(open_file(path)?)?;
        Ok(ImageHead::new((width, height), exif.as_deref(), FileKind::Png(png), length))
    }

    fn of_other(file: File, length: u64, format: ImageFormat) -> Result<ImageHead, DecodeError> {
        let mut file = BufReader::new(file);
        match format {
            ImageFormat::Tiff => tiff::check_counts(&mut file, length)?,
            ImageFormat::WebP => webp::check_chunks(&mut file, length)?,
            _ => {}
        }
        file.rewind()?;
        let mut decoder =
            ImageReader::with_format(file, format).into_decoder().map_err(DecodeError::Other)?;
        // Damaged EXIF data are no reason to refuse the pixels.
        let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
        let kind = FileKind::Other(format, decoder.color_type());
        Ok(ImageHead { orientation, ..ImageHead::new(decoder.dimensions(), None, kind, length) })
    }

    fn new((width, height): (u32, u32), exif: Option<&[u8]>, kind: FileKind, file: u64) -> ImageHead {
        let orientation = exif.and_then(Orientation::from_exif_chunk).unwrap_or(Orientation::NoTransforms);
        let turned_since = exif.is_some_and(|exif| exif::lies_otherwise(exif, width, height));
        let camera = exif.and_then(ExifCamera::of);
        ImageHead { width, height, orientation, turned_since, camera, kind, file }
    }

    /// The EXIF orientation, where the image has the same size turned by it and as stored.
    pub fn ambiguous_orientation(&self) -> Option<Orientation> {
        let same = self.width == self.height || !swaps_sides(self.orientation);
        (same && self.orientation != Orientation::NoTransforms).then_some(self.orientation)
    }

    /// Whether the image can be transparent.
    pub fn has_alpha(&self) -> bool {
        match &self.kind {
            FileKind::Jpeg(_) => false,
            FileKind::Png(png) => png.channels % 2 == 0,
            FileKind::Other(_, colour) => colour.has_alpha(),
        }
    }

    /// Most bytes that decoding takes for an image that is then shrunk to `width` x `height` of its pixels as stored.
    pub fn bytes_for(&self, width: u32, height: u32) -> u64 {
        let pixels = u64::from(self.width) * u64::from(self.height);
        let least = least(width, height);
        // What the filter that shrinks holds beside the image is at most half of it.
        let half_more = |n: u64| n + n / 2;
        match &self.kind {
            FileKind::Jpeg(jpeg) => {
                let whole = || {
                    let planes = if jpeg.frame.coding == jpeg::Coding::Baseline {
                        0
                    } else {
                        2 * jpeg.frame.samples()
                    };
                    half_more(3 * pixels) + planes
                };
                jpeg.bytes
                    + self.scale(least).map_or_else(whole, |scale| half_more(jpeg.frame.scaled_bytes(scale)))
            }
            FileKind::Png(png) => {
                let step = self.step(least) as u64;
                let pixels = pixels / (step * step);
                let stored = (png.channels * png.depth) as u64;
                pixels * copies(stored, png.depth > 1) + (1 << 20)
            }
            FileKind::Other(_, colour) => {
                let stored = u64::from(colour.bytes_per_pixel());
                // Some formats are unpacked beside the image.
                let wide = colour.bytes_per_pixel() / colour.channel_count() > 1;
                pixels * (stored + copies(stored, wide)) + self.file.min(4 * pixels)
            }
        }
    }

    /// Pixels that a large JPEG leaves of each eight.
    fn scale(&self, least: (f64, f64)) -> Option<usize> {
        let FileKind::Jpeg(jpeg) = &self.kind else { return None };
        let large = u64::from(self.width) * u64::from(self.height) > LARGE && jpeg.frame.scales();
        large.then(|| jpeg.frame.scale_for(least)).filter(|&scale| scale < 8)
    }

    /// Pixels of a side of a large PNG that become one.
    fn step(&self, least: (f64, f64)) -> usize {
        let FileKind::Png(png) = &self.kind else { return 1 };
        if u64::from(self.width) * u64::from(self.height) > LARGE { png::step(png, least) } else { 1 }
    }

    /// Decodes the image for one that is then shrunk to `width` x `height` of its pixels as stored; waits for memory.
    pub fn decode(&self, path: &Path, width: u32, height: u32) -> Result<Decoded, DecodeError> {
        let _permit = memory::enter(self.bytes_for(width, height));
        self.decode_now(path, least(width, height))
    }

    /// Decodes, and passes the image to `then`, which takes so many bytes itself, while its memory is still held.
    pub fn decode_and<T>(
        &self,
        path: &Path,
        (width, height): (u32, u32),
        bytes: u64,
        then: impl FnOnce(Decoded) -> Result<T, DecodeError>,
    ) -> Result<T, DecodeError> {
        let _permit = memory::enter(self.bytes_for(width, height).saturating_add(bytes));
        then(self.decode_now(path, least(width, height))?)
    }

    fn decode_now(&self, path: &Path, least: (f64, f64)) -> Result<Decoded, DecodeError> {
        let file = open_file(path)?;
        let shrunk = |(image, [width, height]): (DynamicImage, [f64; 2])| Decoded {
            image,
            part: [0.0, 0.0, width, height],
        };
        match &self.kind {
            FileKind::Jpeg(jpeg) => {
                let bytes = self.jpeg_bytes(file, jpeg)?;
                match self.scale(least) {
                    Some(scale) => jpeg::scaled(&bytes, &jpeg.frame, scale).map(shrunk),
                    None => jpeg::whole(&bytes).map(Decoded::whole),
                }
            }
            FileKind::Png(_) => match self.step(least) {
                1 => png::whole(file).map(Decoded::whole),
                step => png::scaled(file, step).map(shrunk),
            },
            FileKind::Other(format, _) => {
                let mut decoder = ImageReader::with_format(BufReader::new(file), *format)
                    .into_decoder()
                    .map_err(DecodeError::Other)?;
                if decoder.dimensions() != (self.width, self.height) {
                    return Err(DecodeError::ChangedWhileRead);
                }
                let mut limits = image::Limits::no_limits();
                limits.max_alloc = Some(self.bytes_for(self.width, self.height) + (64 << 20));
                decoder.set_limits(limits).map_err(DecodeError::Other)?;
                DynamicImage::from_decoder(decoder).map(Decoded::whole).map_err(DecodeError::Other)
            }
        }
        .and_then(|decoded| self.fits(decoded))
    }

    /// A file that was changed since its head was read may hold another image.
    fn fits(&self, decoded: Decoded) -> Result<Decoded, DecodeError> {
        let [.., width, height] = decoded.part;
        let shrunk = f64::from(self.width) / width;
        let off = (f64::from(self.height) / shrunk - height).abs();
        if off > 1.0 || width > f64::from(self.width) {
            Err(DecodeError::ChangedWhileRead)
        } else {
            Ok(decoded)
        }
    }

    fn jpeg_bytes(&self, file: File, jpeg: &jpeg::JpegHead) -> Result<Vec<u8>, DecodeError> {
        let mut bytes = Vec::with_capacity(jpeg.bytes as usize + 2);
        file.take(jpeg.bytes).read_to_end(&mut bytes)?;
        if !jpeg::read(&bytes[..]).is_ok_and(|head| head.frame == jpeg.frame) {
            return Err(DecodeError::ChangedWhileRead);
        }
        if !jpeg.ended {
            bytes.extend([0xff, 0xd9]);
        }
        Ok(bytes)
    }

    /// Checks that a JPEG without an end has all of its image.
    ///
    /// # Errors
    /// It has not, or the system refuses the file.
    pub fn check_end(&self, path: &Path) -> Result<(), DecodeError> {
        match &self.kind {
            FileKind::Jpeg(jpeg) if !jpeg.ended => self.check_data(path).map(drop),
            _ => Ok(()),
        }
    }

    /// Looks for damage in a JPEG's data, which decoders pass over in silence; what is odd, though the photo can be used. Other
    /// kinds say of damage when they are decoded.
    ///
    /// # Errors
    /// The damage, where the photo is not to be used.
    pub fn check_data(&self, path: &Path) -> Result<Option<String>, DecodeError> {
        let FileKind::Jpeg(jpeg) = &self.kind else { return Ok(None) };
        let _permit = memory::enter(jpeg.bytes + jpeg.frame.samples() / 8);
        let file = open_file(path)?;
        let mut bytes = Vec::with_capacity(jpeg.bytes as usize);
        file.take(jpeg.bytes).read_to_end(&mut bytes)?;
        let Some(found) = jpeg::check(&bytes, &jpeg.frame) else { return Ok(None) };
        match found.damage(jpeg.bytes) {
            Some(damage) => Err(damage),
            None => Ok(found.oddity(jpeg.ended)),
        }
    }
}

/// Bytes per pixel of a decoded image that has `stored` of them, while it becomes three colours and shrinks.
fn copies(stored: u64, wide: bool) -> u64 {
    if wide { 2 * stored + 16 } else { stored + 5 }
}

/// The least size that a decoder is to leave of an image that is then shrunk.
fn least(width: u32, height: u32) -> (f64, f64) {
    (FINER * f64::from(width), FINER * f64::from(height))
}

fn within(width: u32, height: u32, most_pixels: u64) -> Result<(), DecodeError> {
    if width == 0 || height == 0 {
        return Err(DecodeError::NoPixels { width, height });
    }
    if u64::from(width) * u64::from(height) > most_pixels {
        return Err(DecodeError::TooManyPixels { width, height, most_pixels });
    }
    Ok(())
}

/// Pixels of so many megapixels.
pub(crate) fn pixels_of(megapixels: u32) -> u64 {
    1_000_000 * u64::from(megapixels)
}

/// Decodes an image that is no photo, whole, if it has at most so many pixels.
pub(crate) fn decode_image(path: &Path, most_pixels: u64) -> Result<DynamicImage, DecodeError> {
    let head = ImageHead::read(path, most_pixels)?;
    head.decode(path, head.width, head.height).map(|decoded| decoded.image)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_holes_that_starts_as_a_photo_is_refused_before_it_is_scanned() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("photo.jpg");
        for start in [&b"\xff\xd8\xff\xe0"[..], b"\x89PNG\r\n\x1a\n", b"RIFF\0\0\0\0WEBP", b"II*\0", b"BM"] {
            std::fs::write(&path, start).unwrap();
            File::options().write(true).open(&path).unwrap().set_len(1 << 30).unwrap();
            let refused = ImageHead::read(&path, 1_000_000).unwrap_err();
            assert!(matches!(refused, DecodeError::TooLarge { .. }), "{refused}");
        }
    }

    #[test]
    fn a_pixel_of_a_turned_image_is_found_in_the_stored_one() {
        let stored = image::GrayImage::from_fn(3, 2, |x, y| image::Luma([(3 * y + x) as u8]));
        for exif in 1..=8 {
            let orientation = Orientation::from_exif(exif).expect("1 to 8 are orientations");
            let mut turned = Decoded::whole(stored.clone().into());
            turned.turn(orientation);
            let turned = turned.image.into_luma8();
            assert_eq!(swaps_sides(orientation), turned.dimensions() == (2, 3), "{exif}");
            for (x, y, pixel) in turned.enumerate_pixels() {
                let share = |at: u32, size: u32| (f64::from(at) + 0.5) / f64::from(size);
                let at = [share(x, turned.width()), share(y, turned.height())];
                let [u, v] = before_turn(at, orientation);
                assert_eq!(pixel, stored.get_pixel((u * 3.0) as u32, (v * 2.0) as u32), "{exif}: {x}, {y}");
            }
        }
    }
}
