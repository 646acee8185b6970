//! Photos at the size that they are used in, kept outside the process, so that their files are decoded once.

use crate::eight_bits::{byte, value};
use crate::whole::read_whole;
use crate::{Camera, Image, LoadedPhoto, Mask, View};
use wincode::SchemaWrite;

/// A photo as a record: exact, and a byte per value where the values are those of 8-bit pixels.
///
/// ```
/// use segwild_scene::{Camera, Image, LoadedPhoto, PackedPhoto};
/// let image = Image { width: 1, height: 1, channels: 3, data: vec![0.0, 128.0 / 255.0, 1.0] };
/// let camera = Camera { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
/// let photo = LoadedPhoto { image, camera, valid: None, empty: None };
/// assert_eq!(PackedPhoto::of(&photo).unpack(camera), Some(photo));
/// ```
#[derive(Clone, Debug, PartialEq, SchemaWrite)]
pub struct PackedPhoto {
    width: u32,
    height: u32,
    /// Planes of bytes, as those of [`LoadedPhoto::image`]; empty where there are floats.
    bytes: Vec<u8>,
    /// The same planes as they are: photos of 16 bits have values between bytes.
    floats: Vec<f32>,
    valid: Option<Mask>,
    empty: Option<Mask>,
}

read_whole!(
    PackedPhoto as PackedPhotoRecord {
        width: u32,
        height: u32,
        bytes: Vec<u8>,
        floats: Vec<f32>,
        valid: Option<Mask>,
        empty: Option<Mask>,
    }
    where PackedPhoto::is_whole,
    "a photo has another number of pixels"
);

impl PackedPhoto {
    /// Whether it has three values for each pixel, and masks of its size.
    fn is_whole(&self) -> bool {
        let values = 3 * u128::from(self.width) * u128::from(self.height);
        let lengths = [self.bytes.len(), self.floats.len()].map(|length| length as u128);
        let fits = |mask: &Mask| (mask.width(), mask.height()) == (self.width, self.height);
        (lengths == [values, 0] || lengths == [0, values])
            && [&self.valid, &self.empty].into_iter().flatten().all(fits)
    }

    /// The record of a photo.
    pub fn of(photo: &LoadedPhoto) -> PackedPhoto {
        let LoadedPhoto { image, valid, empty, .. } = photo;
        let bytes: Option<Vec<u8>> = image.data.iter().map(|&v| byte(v)).collect();
        let floats = if bytes.is_some() { Vec::new() } else { image.data.clone() };
        PackedPhoto {
            width: image.width as u32,
            height: image.height as u32,
            bytes: bytes.unwrap_or_default(),
            floats,
            valid: valid.clone(),
            empty: empty.clone(),
        }
    }

    /// The photo, taken by a camera of its size; `None` where the sizes differ.
    pub fn unpack(self, camera: Camera) -> Option<LoadedPhoto> {
        let PackedPhoto { width, height, bytes, floats, valid, empty } = self;
        if (camera.width, camera.height) != (width, height) {
            return None;
        }
        let data = if floats.is_empty() { bytes.into_iter().map(value).collect() } else { floats };
        let image = Image { width: width as usize, height: height as usize, channels: 3, data };
        Some(LoadedPhoto { image, camera, valid, empty })
    }
}

/// Keeps photos at one size outside the process. It need not keep any: a photo that it does not have is decoded again.
pub trait PhotoCache: Send + Sync {
    /// The photo of a view, if it is kept and its file is still the same.
    fn photo(&self, view: usize) -> Option<PackedPhoto>;

    /// Keeps the photo of a view.
    fn keep(&self, view: usize, photo: &PackedPhoto);
}

/// How many times the pixels in use a file has from which on reading those pixels costs much less than decoding it: most of the
/// time of decoding goes to all pixels of the file, whatever the requested size.
const LARGER: u64 = 4;

impl View {
    /// Whether the photo at a long side of so many pixels takes much longer to make of its file than to read: it is used much smaller
    /// than it is, or is undistorted (half a second at 1600 px).
    pub(crate) fn is_dear_at(&self, long_side: u32) -> bool {
        let pixels = |camera: &Camera| u64::from(camera.width) * u64::from(camera.height);
        let used = pixels(&self.camera.scaled_to(long_side.max(1)));
        self.photo.lens.is_some() || pixels(&self.camera) >= LARGER * used
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Camera = Camera { width: 3, height: 2, fx: 3.0, fy: 3.0, cx: 1.5, cy: 1.0 };

    fn photo(data: Vec<f32>) -> LoadedPhoto {
        let image = Image { width: 3, height: 2, channels: 3, data };
        LoadedPhoto { image, camera: CAMERA, valid: Some(Mask::full(3, 2)), empty: None }
    }

    #[test]
    fn every_photo_is_unpacked_as_it_was_and_those_of_8_bits_take_a_byte_per_value() {
        let eight = photo((0..18).map(|i| value(i * 15)).collect());
        let sixteen = photo((0..18u16).map(|i| f32::from(i * 3800 + 7) / 65535.0).collect());
        let odd = photo(vec![f32::NAN; 18]);
        for (photo, bytes) in [(&eight, 18), (&sixteen, 0)] {
            let packed = PackedPhoto::of(photo);
            assert_eq!((packed.bytes.len(), packed.floats.len()), (bytes, 18 - bytes));
            assert_eq!(packed.unpack(CAMERA).as_ref(), Some(photo));
        }
        assert!(PackedPhoto::of(&odd).unpack(CAMERA).unwrap().image.data.iter().all(|v| v.is_nan()));
        assert_eq!(PackedPhoto::of(&eight).unpack(Camera { width: 2, height: 3, ..CAMERA }), None);
    }

    #[test]
    fn a_forged_photo_that_claims_more_pixels_than_it_has_is_refused() {
        let again = |photo: &PackedPhoto| -> Option<PackedPhoto> {
            wincode::deserialize(&wincode::serialize(photo).unwrap()).ok()
        };
        let whole = PackedPhoto::of(&photo(vec![0.0; 18]));
        assert_eq!(again(&whole), Some(whole.clone()));
        let forged = [
            PackedPhoto { width: 4, ..whole.clone() },
            PackedPhoto { width: u32::MAX, height: u32::MAX, ..whole.clone() },
            PackedPhoto { floats: vec![0.0; 18], ..whole.clone() },
            PackedPhoto { empty: Some(Mask::full(2, 2)), ..whole.clone() },
        ];
        assert!(forged.iter().all(|forged| again(forged).is_none()));
    }
}
