//! Loading a photo: decode, turn, undistort, scale down, mark what is not to be trusted.

use crate::decode::{DecodeError, Decoded, ImageHead, swaps_sides};
use crate::digest::file_digest;
use crate::lens::Lens;
use crate::pixel_bits::with_bits_of;
use crate::{Camera, Image, Mask, PhotoError, SceneError, View};
use fast_image_resize as fir;
use image::metadata::Orientation;
use image::{DynamicImage, GenericImageView};
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
    /// True where nothing of the scene stands: transparent, and [`crate::Reading::empty`]. Such a pixel is not `valid`, for it shows
    /// no colour of the scene.
    pub empty: Option<Mask>,
}

impl LoadedPhoto {
    /// Bytes of its pixels and masks.
    pub fn bytes(&self) -> usize {
        let masks = [&self.valid, &self.empty].into_iter().flatten();
        4 * self.image.data.len()
            + masks.map(|mask| mask.width() as usize * mask.height() as usize / 8).sum::<usize>()
    }
}

/// Most pixels of a photo that belongs to no scene.
const MOST_PIXELS: u64 = 1 << 28;

/// Decodes a photo that belongs to no scene: turned by its EXIF orientation, scaled down so that its long side is at most `long_side`.
/// sRGB in [0, 1].
///
/// # Errors
/// When the file cannot be read, is no photo, or is damaged.
pub fn load_photo(path: &Path, long_side: u32) -> Result<Image, SceneError> {
    let load = || -> Result<Image, DecodeError> {
        let head = ImageHead::read(path, MOST_PIXELS)?;
        head.check_end(path)?;
        let orientation = if head.turned_since { Orientation::NoTransforms } else { head.orientation };
        let swaps = swaps_sides(orientation);
        let (width, height) = if swaps { (head.height, head.width) } else { (head.width, head.height) };
        let whole = Camera { width, height, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        let (width, height) = whole.size_for(long_side.max(1));
        let stored = if swaps { (height, width) } else { (width, height) };
        head.decode_and(path, stored, 0, |mut decoded| {
            decoded.turn(orientation);
            shrink(decoded, width, height)
        })
    };
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    load().map_err(|e| SceneError::Photo { name, path: path.to_owned(), reason: e.into() })
}

impl View {
    /// Decodes the photo, undistorted and scaled down so that its long side is at most `long_side` (never
    /// enlarged). A [`PhotoStore`](crate::PhotoStore) decodes by it, and is what reads photos at the size of a run; whoever calls
    /// this directly needs a photo once at a size of its own.
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
        let path = &self.photo.path;
        let (head, orientation) = self.head().map_err(|e| self.photo_error(path, e))?;
        head.check_end(path).map_err(|e| self.photo_error(path, e))?;
        let camera = self.camera.scaled_to(long_side.max(1));
        // Bending blurs a little, so it happens at up to twice the requested size.
        let fine = self.photo.lens.as_ref().map(|lens| (lens, bent(&self.camera, long_side)));
        let size = fine.as_ref().map_or(&camera, |(_, fine)| fine);
        let shrunk = |mut decoded: Decoded| {
            decoded.turn(orientation);
            let opaque = head.has_alpha().then(|| opaque(&decoded, camera.width, camera.height));
            if self.photo.reading.empty {
                decoded.image = before_grey(decoded.image);
            }
            let image = shrink(decoded, size.width, size.height)?;
            let Some((lens, fine)) = &fine else { return Ok((image, opaque)) };
            let straight = straighten(&image, &lens.resized(fine.width, fine.height), fine)
                .resized(camera.width as usize, camera.height as usize);
            // As it was taken: the training keeps 8 bits, and a cache then takes a quarter of the bytes.
            Ok((with_bits_of(&image, straight), opaque))
        };
        let bent_bytes =
            fine.as_ref().map_or(0, |(_, fine)| BENT * u64::from(fine.width) * u64::from(fine.height));
        let size = stored(size, swaps_sides(orientation));
        let (image, mut valid) =
            head.decode_and(path, size, bent_bytes, shrunk).map_err(|e| self.photo_error(path, e))?;
        let empty_of =
            |opaque: &Option<Mask>| opaque.as_ref().filter(|_| self.photo.reading.empty).map(Mask::not);
        let mut empty = empty_of(&valid);
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
            empty = empty_of(&valid).map(|empty| empty.and(&photographed));
            valid = Some(valid.map_or(photographed.clone(), |v| v.and(&photographed)));
        }
        for (path, white) in self.masks() {
            let ignored = self.ignored(path, white, &camera)?;
            empty = empty.map(|empty| empty.minus(&ignored));
            valid = Some(valid.map_or_else(|| ignored.not(), |v| v.minus(&ignored)));
        }
        Ok(LoadedPhoto { image, camera, valid, empty })
    }

    /// Whether the photo and its masks are still the files that they were when the scene was opened.
    ///
    /// # Errors
    /// Names the file that has changed or gone.
    pub fn intact(&self) -> Result<(), SceneError> {
        let Some(path) = self.photo.seal.broken() else { return Ok(()) };
        Err(SceneError::Changed { name: self.name.clone(), path: path.to_owned() })
    }

    /// BLAKE3 of the photo's bytes, in hexadecimal: what a cache key needs of the photo.
    pub fn digest(&self) -> Result<String, SceneError> {
        let path = &self.photo.path;
        file_digest(path).map_err(|e| self.photo_error(path, DecodeError::Io(e)))
    }

    /// Decodes the photo once at a small size, and looks for damage that decoders pass over: whether it can be used at all, at
    /// a long side of so many pixels. What is odd about it, in words, where it can.
    ///
    /// # Errors
    /// Also when its masks leave nothing of it, or all of it is transparent.
    pub fn examine(&self, long_side: u32) -> Result<Option<String>, SceneError> {
        self.examine_as(|| self.load(EXAMINED.min(long_side)))
    }

    /// [`View::examine`] of the photo as somebody loads it.
    pub(crate) fn examine_as(
        &self,
        load: impl FnOnce() -> Result<LoadedPhoto, SceneError>,
    ) -> Result<Option<String>, SceneError> {
        let path = &self.photo.path;
        let (head, _) = self.head().map_err(|e| self.photo_error(path, e))?;
        let odd = head.check_data(path).map_err(|e| self.photo_error(path, e))?;
        let nothing_left = load()?.valid.is_some_and(|valid| valid.is_empty());
        match (nothing_left, self.masks().next().is_some()) {
            (true, true) => Err(self.photo_error(path, PhotoError::MaskedOut)),
            (true, false) => Err(self.photo_error(path, PhotoError::Transparent)),
            _ => Ok(odd),
        }
    }

    /// Pixels that the photo and its masks may have: the photo itself was within the bound when the scene was opened.
    fn most_pixels(&self) -> u64 {
        let own = u64::from(self.camera.width) * u64::from(self.camera.height);
        own.max(self.photo.reading.most_pixels)
    }

    /// Most bytes that decoding the photo for this size or one of its masks takes, as their heads say; what cannot be read takes
    /// none.
    pub(crate) fn decoding_bytes(&self, long_side: u32) -> u64 {
        let of_photo = |head: ImageHead| head.photo_bytes(&self.camera, self.photo.lens.is_some(), long_side);
        let photo = ImageHead::read(&self.photo.path, self.most_pixels()).map_or(0, of_photo);
        photo.max(self.mask_bytes())
    }

    fn mask_bytes(&self) -> u64 {
        self.masks().map(|(path, _)| bytes_of(path, self.most_pixels())).max().unwrap_or(0)
    }

    /// The photo's head, and how the stored pixels are turned to agree with the camera and its pose.
    fn head(&self) -> Result<(ImageHead, Orientation), PhotoError> {
        let head = ImageHead::read(&self.photo.path, self.most_pixels())?;
        let by_size = head.turned(self.camera.width, self.camera.height)?.is_some();
        let turned = by_size || self.photo.reading.turned;
        let orientation = if turned { head.orientation } else { Orientation::NoTransforms };
        Ok((head, orientation))
    }

    /// The photo as stored: neither turned nor undistorted, scaled down to a long side of at most `long_side`. For photos whose
    /// stored size has the camera's shape.
    pub(crate) fn stored_pixels(&self, long_side: u32) -> Result<Image, PhotoError> {
        let (head, _) = self.head()?;
        let Camera { width, height, .. } = self.camera.scaled_to(long_side);
        Ok(head.decode_and(&self.photo.path, (width, height), 0, |decoded| shrink(decoded, width, height))?)
    }

    /// Its masks, and whether white is ignored in them.
    fn masks(&self) -> impl Iterator<Item = (&Path, bool)> {
        let ignore = self.photo.ignore.iter().map(|path| (path.as_path(), true));
        ignore.chain(self.photo.usable.iter().map(|path| (path.as_path(), false)))
    }

    /// Whether its masks leave nothing of it; a mask that cannot be read, or takes much memory, leaves all: [`View::examine`]
    /// decides then.
    pub(crate) fn is_masked_out(&self) -> bool {
        if self.mask_bytes() > CHEAP {
            return false;
        }
        let mut rest = Mask::full(self.camera.width, self.camera.height);
        for (path, white) in self.masks() {
            let Ok(ignored) = self.ignored(path, white, &self.camera) else { return false };
            rest = rest.minus(&ignored);
        }
        rest.is_empty()
    }

    /// Adds the photo's name and file to what is wrong with it.
    fn photo_error(&self, path: &Path, reason: impl Into<PhotoError>) -> SceneError {
        SceneError::Photo { name: self.name.clone(), path: path.to_owned(), reason: reason.into() }
    }

    /// The pixels of the loaded photo that a mask's white touches, or its black.
    fn ignored(&self, path: &Path, white: bool, camera: &Camera) -> Result<Mask, SceneError> {
        let mask = Mask::read_within(path, self.most_pixels())?;
        let mask = if white { mask } else { mask.not() };
        let (w, h) = (mask.width(), mask.height());
        let Camera { width, height, .. } = self.camera;
        if !same_aspect((w, h), (width, height)) {
            let mask = path.to_owned();
            let reason = PhotoError::MaskShape { mask, mask_width: w, mask_height: h, width, height };
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

/// Bytes that decoding one image may take while a scene is opened, for no memory budget is set by then.
const CHEAP: u64 = 64 << 20;
/// The same where nearly no image of the scene takes less: one of 12 megapixels in any format.
pub(crate) const DEAR: u64 = 256 << 20;

/// Of images, each with the bytes that decoding it takes, those that may be decoded while a scene is opened: the cheap ones, or
/// also dearer ones where the cheap are fewer than `wanted` and not all.
pub(crate) fn cheap_ones<T>(images: Vec<(T, u64)>, wanted: usize) -> Vec<T> {
    let cheap = images.iter().filter(|(_, bytes)| *bytes <= CHEAP).count();
    let most = if cheap >= wanted { CHEAP } else { DEAR };
    images.into_iter().filter(|(_, bytes)| *bytes <= most).map(|(image, _)| image).collect()
}

/// Most bytes that decoding a whole image of at most so many pixels takes; none where it cannot be decoded.
pub(crate) fn bytes_of(path: &Path, most_pixels: u64) -> u64 {
    ImageHead::read(path, most_pixels).map_or(0, |head| head.bytes_for(head.width, head.height))
}

/// Longest side at which a photo is examined.
const EXAMINED: u32 = 256;

/// Bytes per pixel that undistorting takes: three numbers for the photo as taken, and three for what becomes of it.
const BENT: u64 = 24;

/// The size at which a photo is undistorted.
fn bent(camera: &Camera, long_side: u32) -> Camera {
    camera.scaled_to(long_side.max(1).saturating_mul(2))
}

/// A size in the orientation in which a photo is stored.
fn stored(size: &Camera, turned: bool) -> (u32, u32) {
    if turned { (size.height, size.width) } else { (size.width, size.height) }
}

impl ImageHead {
    /// Size as stored, without regard to the orientation: what COLMAP sees.
    pub(crate) fn stored(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// Whether the photo must be turned by its EXIF orientation to agree with a camera of this size, and if so,
    /// `Some` of the turned size; an error when it does not agree either way.
    ///
    /// COLMAP ignores EXIF and other programs apply it, so the sizes decide. Where they are the same, the photo is not turned here,
    /// and the points decide ([`crate::orientation`]).
    fn turned(&self, camera_width: u32, camera_height: u32) -> Result<Option<(u32, u32)>, PhotoError> {
        let ImageHead { width, height, .. } = *self;
        let (stored, turned) = ((width, height), (height, width));
        let turns = swaps_sides(self.orientation);
        let camera = (camera_width, camera_height);
        if stored == camera {
            Ok(None)
        } else if self.turned_since && same_aspect(turned, camera) {
            // Which way they were turned nothing says: the orientation is that of the pixels before.
            Err(PhotoError::TurnedSince { width, height, camera_width, camera_height })
        } else if turns && turned == camera {
            Ok(Some(turned))
        } else if same_aspect(stored, camera) {
            Ok(None)
        } else if turns && same_aspect(turned, camera) {
            Ok(Some(turned))
        } else {
            Err(PhotoError::OtherShape { width, height, camera_width, camera_height })
        }
    }

    /// Most bytes that decoding the photo for a long side takes, beside what it is then.
    pub(crate) fn photo_bytes(&self, camera: &Camera, distorted: bool, long_side: u32) -> u64 {
        let turned = self.turned(camera.width, camera.height).is_ok_and(|turned| turned.is_some());
        let size = if distorted { bent(camera, long_side) } else { camera.scaled_to(long_side.max(1)) };
        let (width, height) = stored(&size, turned);
        self.bytes_for(width, height)
    }

    /// The photo's size in the orientation that agrees with a camera of this size.
    pub(crate) fn size_for(&self, width: u32, height: u32) -> Result<(u32, u32), PhotoError> {
        Ok(self.turned(width, height)?.unwrap_or(self.stored()))
    }
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
fn opaque(photo: &Decoded, width: u32, height: u32) -> Mask {
    let [left, top, w, h] = photo.part;
    Mask::from_fn(width, height, |x, y| {
        let u = (f64::from(x) + 0.5) * w / f64::from(width) + left;
        let v = (f64::from(y) + 0.5) * h / f64::from(height) + top;
        photo.image.get_pixel(u as u32, v as u32).0[3] > 127
    })
}

/// A cut-out before mid-grey: what lies under its transparent part is of no meaning and must not bleed into its edges.
fn before_grey(photo: DynamicImage) -> DynamicImage {
    let wide = photo.color().bytes_per_pixel() / photo.color().channel_count() > 1;
    if !photo.color().has_alpha() {
        return photo;
    }
    if wide {
        let mut photo = photo.into_rgba16();
        for pixel in photo.pixels_mut() {
            let alpha = f32::from(pixel.0[3]) / 65535.0;
            pixel.0 = pixel.0.map(|v| (f32::from(v) * alpha + 32767.5 * (1.0 - alpha)).round() as u16);
        }
        return photo.into();
    }
    let mut photo = photo.into_rgba8();
    for pixel in photo.pixels_mut() {
        let alpha = f32::from(pixel.0[3]) / 255.0;
        pixel.0 = pixel.0.map(|v| (f32::from(v) * alpha + 127.5 * (1.0 - alpha)).round() as u8);
    }
    photo.into()
}

/// Scales to a size with Lanczos in the photo's own depth, 8 or 16 bits; then to planes of floats.
fn shrink(photo: Decoded, width: u32, height: u32) -> Result<Image, DecodeError> {
    let Decoded { image: photo, part: [left, top, part_width, part_height] } = photo;
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
    let all = [left, top, part_width, part_height] == [0.0, 0.0, f64::from(w), f64::from(h)];
    let source = if deep {
        let mut source = fir::images::Image::new(w, h, fir::PixelType::U16x3);
        for (to, from) in source.buffer_mut().chunks_exact_mut(2).zip(photo.into_rgb16().iter()) {
            to.copy_from_slice(&from.to_ne_bytes());
        }
        source
    } else {
        fir::images::Image::from_vec_u8(w, h, photo.into_rgb8().into_raw(), fir::PixelType::U8x3)
            .map_err(DecodeError::Pixels)?
    };
    let scaled = if all && (w, h) == (width, height) {
        source
    } else {
        let mut scaled = fir::images::Image::new(width, height, source.pixel_type());
        let lanczos = fir::ResizeAlg::Convolution(fir::FilterType::Lanczos3);
        let mut how = fir::ResizeOptions::new().resize_alg(lanczos);
        if !all {
            how = how.crop(left, top, part_width, part_height);
        }
        if deep {
            resize::<fir::pixels::U16x3>(&source, &mut scaled, &how)?;
        } else {
            resize::<fir::pixels::U8x3>(&source, &mut scaled, &how)?;
        }
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

/// Scales an image whose pixels are `P`. `Resizer::resize` finds the type by itself, and so compiles the convolutions of all
/// thirteen into this crate: half of its time to compile.
fn resize<P: fir::PixelTrait>(
    from: &fir::images::Image<'_>,
    to: &mut fir::images::Image<'_>,
    options: &fir::ResizeOptions,
) -> Result<(), DecodeError> {
    let unlike = || DecodeError::Resize(fir::ResizeError::PixelTypesAreDifferent);
    let source = from.typed_image::<P>().ok_or_else(unlike)?;
    let mut target = to.typed_image_mut::<P>().ok_or_else(unlike)?;
    fir::Resizer::new().resize_typed(&source, &mut target, options).map_err(DecodeError::Resize)
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
pub(crate) fn sample(image: &Image, p: [f64; 2], mut put: impl FnMut(usize, f32)) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_large_image_among_small_ones_is_not_decoded_to_learn_what_they_are() {
        let kept = |mib: &[u64]| cheap_ones(mib.iter().map(|mib| (*mib, mib << 20)).collect(), 2);
        assert_eq!(kept(&[1, 700, 2, 100]), [1, 2]);
        // Where all are as large as photos are, those are looked at; what is larger never.
        assert_eq!(kept(&[100, 100, 1]), [100, 100, 1]);
        assert!(kept(&[700, 900]).is_empty());
    }

    #[test]
    fn what_a_large_tiff_takes_is_known_before_it_is_decoded() {
        let entry = |tag: u16, kind: u16, count: u32, value: u32| {
            [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &count.to_le_bytes(), &value.to_le_bytes()].concat()
        };
        let (width, height) = (11_200, 8_400);
        let entries = [
            entry(256, 4, 1, width),
            entry(257, 4, 1, height),
            entry(258, 3, 4, 8),
            entry(259, 3, 1, 8),
            entry(262, 3, 1, 2),
            entry(273, 4, 1, 1_000),
            entry(277, 3, 1, 4),
            entry(278, 4, 1, height),
            entry(279, 4, 1, 5),
            entry(284, 3, 1, 1),
            entry(338, 3, 1, 2),
        ];
        let directory = [&(entries.len() as u16).to_le_bytes()[..], &entries.concat(), &[0; 4]].concat();
        let mut file = [b"II*\0\x10\0\0\0", &[8, 0, 8, 0, 8, 0, 8, 0][..], &directory].concat();
        file.resize(1_005, 0);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("large.tif");
        std::fs::write(&path, file).unwrap();
        let head = ImageHead::read(&path, 200_000_000).unwrap();
        assert!(head.has_alpha());
        // A TIFF does not shrink while it is decoded.
        assert!(bytes_of(&path, 200_000_000) > DEAR && head.bytes_for(160, 120) > DEAR);
        assert_eq!(bytes_of(&path, 90_000_000), 0, "what has too many pixels is not decoded at all");
    }
}
