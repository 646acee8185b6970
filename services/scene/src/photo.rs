//! Loading a photo: decode, turn, undistort, scale down, mark what is not to be trusted.

use crate::lens::Lens;
use crate::{Camera, Image, Mask, SceneError, View};
use fast_image_resize as fir;
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageReader};
use std::io::{Cursor, Read};
use std::path::Path;

/// A photo ready for training.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedPhoto {
    /// Three planes, sRGB values in [0, 1].
    pub image: Image,
    /// The camera at the size of `image`.
    pub camera: Camera,
    /// False where a pixel is not to be trusted: ignored by the user's mask, transparent, or outside the photo
    /// after undistortion. `None` when every pixel is good.
    pub valid: Option<Mask>,
}

impl View {
    /// Decodes the photo, undistorted and scaled down so that its long side is at most `long_side` (never
    /// enlarged).
    ///
    /// # Errors
    /// Also when the photo is not the file any more that it was when the scene was opened.
    pub fn load(&self, long_side: u32) -> Result<LoadedPhoto, SceneError> {
        let loaded = self.read(long_side);
        // Last: what is read while the file changes may be half of the one and half of the other.
        self.intact()?;
        loaded
    }

    fn read(&self, long_side: u32) -> Result<LoadedPhoto, SceneError> {
        let fail = |reason: String| self.photo_error(&self.photo.path, reason);
        let decoded = self.decode()?;
        let camera = self.camera.scaled_to(long_side.max(1));
        let mut valid = decoded.color().has_alpha().then(|| opaque(&decoded, camera.width, camera.height));
        let image = match &self.photo.lens {
            None => shrink(decoded, camera.width, camera.height).map_err(fail)?,
            Some(lens) => {
                // Bending blurs a little, so it happens at up to twice the size asked for.
                let fine = self.camera.scaled_to(long_side.max(1).saturating_mul(2));
                let bent = shrink(decoded, fine.width, fine.height).map_err(fail)?;
                straighten(&bent, &lens.resized(fine.width, fine.height), &fine)
                    .resized(camera.width as usize, camera.height as usize)
            }
        };
        if let Some(lens) = &self.photo.lens {
            let lens = lens.resized(camera.width, camera.height);
            // Transparency is a matter of the photo as taken: look it up through the lens.
            valid = valid.map(|v| {
                Mask::from_fn(camera.width, camera.height, |x, y| {
                    let p = lens.distort([f64::from(x) + 0.5, f64::from(y) + 0.5]);
                    p.is_some_and(|p| v.at(p[0] as f32, p[1] as f32))
                })
            });
            let photographed = photographed(&lens);
            valid = Some(valid.map_or(photographed.clone(), |v| v.and(&photographed)));
        }
        for (path, white) in self.masks() {
            let ignored = self.ignored(path, white, &camera)?;
            valid = Some(valid.map_or_else(|| ignored.not(), |v| v.minus(&ignored)));
        }
        Ok(LoadedPhoto { image, camera, valid })
    }

    /// Whether the photo and its masks are still the files that they were when the scene was opened.
    ///
    /// # Errors
    /// Names the file that has changed or gone.
    pub fn intact(&self) -> Result<(), SceneError> {
        let Some(path) = self.photo.seal.broken() else { return Ok(()) };
        let reason =
            "the file was changed or taken away while it was in use; put it back, or run again without it";
        Err(self.photo_error(path, reason.into()))
    }

    /// BLAKE3 of the photo's bytes, in hexadecimal: what a cache key needs of the photo.
    pub fn digest(&self) -> Result<String, SceneError> {
        let path = &self.photo.path;
        let bytes = std::fs::read(path).map_err(|e| self.photo_error(path, e.to_string()))?;
        Ok(blake3::hash(&bytes).to_hex().to_string())
    }

    /// Its masks, and whether white is ignored in them.
    fn masks(&self) -> impl Iterator<Item = (&Path, bool)> {
        let ignore = self.photo.ignore.iter().map(|path| (path.as_path(), true));
        ignore.chain(self.photo.usable.iter().map(|path| (path.as_path(), false)))
    }

    /// Whether its masks leave nothing of it; a mask that cannot be read leaves all.
    pub(crate) fn is_masked_out(&self) -> bool {
        let mut rest = Mask::full(self.camera.width, self.camera.height);
        for (path, white) in self.masks() {
            let Ok(ignored) = self.ignored(path, white, &self.camera) else { return false };
            rest = rest.minus(&ignored);
        }
        rest.is_empty()
    }

    fn photo_error(&self, path: &Path, reason: String) -> SceneError {
        SceneError::Photo { name: self.name.clone(), path: path.to_owned(), reason }
    }

    fn decode(&self) -> Result<DynamicImage, SceneError> {
        let path = &self.photo.path;
        let fail = |reason: String| self.photo_error(path, reason);
        let (mut decoder, header) = open(path).map_err(fail)?;
        let turned = header.turned(self.camera.width, self.camera.height).map_err(fail)?;
        decoder.set_limits(image::Limits::default()).map_err(|e| fail(e.to_string()))?;
        let mut decoded =
            DynamicImage::from_decoder(decoder).map_err(|e| fail(format!("does not decode: {e}")))?;
        if turned.is_some() {
            decoded.apply_orientation(header.orientation);
        }
        Ok(decoded)
    }

    /// The pixels of the loaded photo that a mask's white touches, or its black.
    fn ignored(&self, path: &Path, white: bool, camera: &Camera) -> Result<Mask, SceneError> {
        let mask = Mask::read_png(path)?;
        let mask = if white { mask } else { mask.not() };
        let (w, h) = (mask.width(), mask.height());
        if !same_aspect((w, h), (self.camera.width, self.camera.height)) {
            let reason = format!(
                "its mask {} has {w} x {h} pixels, which does not fit the photo's {} x {}",
                path.display(),
                self.camera.width,
                self.camera.height
            );
            return Err(self.photo_error(path, reason));
        }
        let lens = self.photo.lens.as_ref().map(|l| l.resized(camera.width, camera.height));
        let scale = (f64::from(w) / f64::from(camera.width), f64::from(h) / f64::from(camera.height));
        // A pixel is ignored when any part of it is: samples at most half a pixel of the mask apart, up to 8 x 8.
        let n = ((scale.0.max(scale.1) * 2.0).ceil() as u32).clamp(1, 8);
        let touched = |x: u32, y: u32| {
            (0..n * n).any(|k| {
                let inside = |at: u32, step: u32| f64::from(at) + (f64::from(step) + 0.5) / f64::from(n);
                let p = [inside(x, k % n), inside(y, k / n)];
                let p = match &lens {
                    Some(lens) => lens.distort(p),
                    None => Some(p),
                };
                p.is_some_and(|p| mask.at((p[0] * scale.0) as f32, (p[1] * scale.1) as f32))
            })
        };
        Ok(Mask::from_fn(camera.width, camera.height, touched))
    }
}

/// What the head of a photo's file says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Header {
    /// Size as stored.
    width: u32,
    height: u32,
    /// The EXIF orientation.
    orientation: Orientation,
}

impl Header {
    /// Reads the head of a file; nothing is decoded.
    pub(crate) fn read(path: &Path) -> Result<Header, String> {
        open(path).map(|(_, header)| header)
    }

    /// Size as stored, without regard to the orientation: what COLMAP sees.
    pub(crate) fn stored(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// Whether the photo must be turned by its EXIF orientation to agree with a camera of this size, and if so,
    /// `Some` of the turned size; an error in words when it does not agree either way.
    ///
    /// COLMAP ignores EXIF and other programs apply it, so the sizes decide.
    fn turned(&self, width: u32, height: u32) -> Result<Option<(u32, u32)>, String> {
        let stored = (self.width, self.height);
        let turned = (self.height, self.width);
        let turns = matches!(
            self.orientation,
            Orientation::Rotate90
                | Orientation::Rotate270
                | Orientation::Rotate90FlipH
                | Orientation::Rotate270FlipH
        );
        let camera = (width, height);
        if stored == camera {
            Ok(None)
        } else if turns && turned == camera {
            Ok(Some(turned))
        } else if same_aspect(stored, camera) {
            Ok(None)
        } else if turns && same_aspect(turned, camera) {
            Ok(Some(turned))
        } else {
            Err(format!(
                "the photo has {} x {} pixels, but its camera is for {width} x {height}; the shapes differ, so the \
                 photo is not the one that was reconstructed",
                self.width, self.height
            ))
        }
    }

    /// The photo's size in the orientation that agrees with a camera of this size.
    pub(crate) fn size_for(&self, width: u32, height: u32) -> Result<(u32, u32), String> {
        Ok(self.turned(width, height)?.unwrap_or(self.stored()))
    }
}

fn open(path: &Path) -> Result<(Box<dyn ImageDecoder>, Header), String> {
    let readable = |e: image::ImageError| match e {
        image::ImageError::Unsupported(_) => "is neither a JPEG nor a PNG file that can be read".to_owned(),
        e => format!("does not decode: {e}"),
    };
    let words = |e: std::io::Error| e.to_string();
    let mut file = std::fs::File::open(path).map_err(words)?;
    let mut start = Vec::new();
    file.by_ref().take(2).read_to_end(&mut start).map_err(words)?;
    let mut decoder: Box<dyn ImageDecoder> = if start == JPEG_START {
        // The decoder fills what a JPEG lacks with grey, so whether it is whole has to be seen here.
        file.read_to_end(&mut start).map_err(words)?;
        if !jpeg_ends(&start) {
            return Err("the file is cut short: the JPEG has no end; copy the photo again".into());
        }
        let reader = ImageReader::with_format(Cursor::new(start), image::ImageFormat::Jpeg);
        Box::new(reader.into_decoder().map_err(readable)?)
    } else {
        let reader = ImageReader::open(path).map_err(words)?.with_guessed_format().map_err(words)?;
        Box::new(reader.into_decoder().map_err(readable)?)
    };
    let (width, height) = decoder.dimensions();
    // Damaged EXIF data are no reason to refuse the pixels.
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    if width == 0 || height == 0 {
        return Err(format!("the photo has {width} x {height} pixels"));
    }
    Ok((decoder, Header { width, height, orientation }))
}

const JPEG_START: [u8; 2] = [0xff, 0xd8];

/// Whether the image of a JPEG ends with the marker for it: walks from segment to segment, since thumbnails inside
/// segments have ends of their own.
fn jpeg_ends(bytes: &[u8]) -> bool {
    let mut at = JPEG_START.len();
    while at + 1 < bytes.len() {
        match (bytes[at], bytes[at + 1]) {
            (0xff, 0xd9) => return true,
            // Fill bytes, stuffed bytes of the entropy-coded data, restart markers.
            (0xff, 0xff) => at += 1,
            (0xff, 0x00 | 0x01 | 0xd0..=0xd8) => at += 2,
            // Segments say how long they are; the data of a scan follow the segment that announces it.
            (0xff, _) => match bytes.get(at + 2..at + 4) {
                Some(length) => at += 2 + usize::from(u16::from_be_bytes([length[0], length[1]])),
                None => return false,
            },
            _ => at += 1,
        }
    }
    false
}

/// Whether one size is the other scaled uniformly and rounded to whole pixels.
fn same_aspect(a: (u32, u32), b: (u32, u32)) -> bool {
    let range = |n: u32, of: u32| {
        let (n, of) = (f64::from(n), f64::from(of));
        ((n - 1.0) / of, (n + 1.0) / of)
    };
    let (x, y) = (range(a.0, b.0), range(a.1, b.1));
    x.0.max(y.0) <= x.1.min(y.1)
}

/// The pixels of the target that are opaque in a photo with an alpha channel.
fn opaque(photo: &DynamicImage, width: u32, height: u32) -> Mask {
    let alpha = photo.to_rgba8();
    let full = Mask::from_fn(alpha.width(), alpha.height(), |x, y| alpha.get_pixel(x, y).0[3] > 127);
    full.resized(width, height)
}

/// Scales to a size with Lanczos in the photo's own depth, 8 or 16 bits; then to planes of floats.
fn shrink(photo: DynamicImage, width: u32, height: u32) -> Result<Image, String> {
    let deep = matches!(
        photo,
        DynamicImage::ImageLuma16(_)
            | DynamicImage::ImageLumaA16(_)
            | DynamicImage::ImageRgb16(_)
            | DynamicImage::ImageRgba16(_)
            | DynamicImage::ImageRgb32F(_)
            | DynamicImage::ImageRgba32F(_)
    );
    let (w, h) = (photo.width(), photo.height());
    let source = if deep {
        let mut source = fir::images::Image::new(w, h, fir::PixelType::U16x3);
        for (to, from) in source.buffer_mut().chunks_exact_mut(2).zip(photo.into_rgb16().iter()) {
            to.copy_from_slice(&from.to_ne_bytes());
        }
        source
    } else {
        fir::images::Image::from_vec_u8(w, h, photo.into_rgb8().into_raw(), fir::PixelType::U8x3)
            .map_err(|e| e.to_string())?
    };
    let scaled = if (w, h) == (width, height) {
        source
    } else {
        let mut scaled = fir::images::Image::new(width, height, source.pixel_type());
        let how =
            fir::ResizeOptions::new().resize_alg(fir::ResizeAlg::Convolution(fir::FilterType::Lanczos3));
        fir::Resizer::new().resize(&source, &mut scaled, &how).map_err(|e| e.to_string())?;
        scaled
    };
    let mut image = Image::zeros(width as usize, height as usize, 3);
    let pixels = image.pixels();
    let bytes = scaled.buffer();
    for i in 0..3 * pixels {
        let value = if deep {
            f32::from(u16::from_ne_bytes([bytes[2 * i], bytes[2 * i + 1]])) / 65535.0
        } else {
            f32::from(bytes[i]) / 255.0
        };
        image.data[i % 3 * pixels + i / 3] = value;
    }
    Ok(image)
}

/// The photo as the pinhole would have taken it; black where there is nothing.
fn straighten(bent: &Image, lens: &Lens, camera: &Camera) -> Image {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut image = Image::zeros(width, height, bent.channels);
    for y in 0..height {
        for x in 0..width {
            if let Some(p) = lens.distort([x as f64 + 0.5, y as f64 + 0.5])
                && p[0] >= 0.0
                && p[1] >= 0.0
                && p[0] < f64::from(camera.width)
                && p[1] < f64::from(camera.height)
            {
                sample(bent, p, |c, value| image.data[(c * height + y) * width + x] = value);
            }
        }
    }
    image
}

/// Catmull-Rom interpolation of every plane at a pixel position, the border repeated, kept within [0, 1].
fn sample(image: &Image, p: [f64; 2], mut put: impl FnMut(usize, f32)) {
    let taps = |at: f64, size: usize| {
        let at = at - 0.5;
        let base = at.floor();
        let t = (at - base) as f32;
        let weights = [
            ((2.0 - t) * t - 1.0) * t * 0.5,
            ((3.0 * t - 5.0) * t * t + 2.0) * 0.5,
            ((4.0 - 3.0 * t) * t + 1.0) * t * 0.5,
            (t - 1.0) * t * t * 0.5,
        ];
        let index = [-1.0, 0.0, 1.0, 2.0].map(|o: f64| (base + o).clamp(0.0, size as f64 - 1.0) as usize);
        (index, weights)
    };
    let (xs, wx) = taps(p[0], image.width);
    let (ys, wy) = taps(p[1], image.height);
    for c in 0..image.channels {
        let mut value = 0.0;
        for j in 0..4 {
            let row = (c * image.height + ys[j]) * image.width;
            let line: f32 = (0..4).map(|i| wx[i] * image.data[row + xs[i]]).sum();
            value += wy[j] * line;
        }
        put(c, value.clamp(0.0, 1.0));
    }
}

/// The pixels of the pinhole all of whose corners the photo shows.
fn photographed(lens: &Lens) -> Mask {
    let (w, h) = (lens.width(), lens.height());
    // A hair of slack, so that a lens that bends nothing at the border loses nothing there.
    let inside = |p: [f64; 2]| {
        p[0] > -1e-6 && p[1] > -1e-6 && p[0] < f64::from(w) + 1e-6 && p[1] < f64::from(h) + 1e-6
    };
    let corners =
        Mask::from_fn(w + 1, h + 1, |x, y| lens.distort([f64::from(x), f64::from(y)]).is_some_and(inside));
    Mask::from_fn(w, h, |x, y| (0..4).all(|k| corners.get(x + k % 2, y + k / 2)))
}
