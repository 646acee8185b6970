//! Photos at the size that they are used in, kept outside the process, so that their files are decoded once.

use crate::pixel_bits::PixelBits;
use crate::whole::read_whole;
use crate::{Camera, Image, LoadedPhoto, Mask, View};
use wincode::{SchemaRead, SchemaWrite};

/// A photo as a record: exact, and of as many bits per value as the photo's pixels have.
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
    /// Those of [`LoadedPhoto::image`].
    planes: StoredPlanes,
    valid: Option<Mask>,
    empty: Option<Mask>,
}

/// Colour planes, one after the other.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
enum StoredPlanes {
    /// Of pixels of 8 bits.
    Eight(Vec<u8>),
    /// Of pixels of 16 bits.
    Sixteen(Vec<u16>),
    /// Of others.
    Floats(Vec<f32>),
}

impl StoredPlanes {
    fn of(data: &[f32]) -> StoredPlanes {
        fn bits<T: PixelBits>(data: &[f32]) -> Option<Vec<T>> {
            data.iter().map(|&v| T::of(v)).collect()
        }
        let sixteen = || bits(data).map(StoredPlanes::Sixteen);
        bits(data)
            .map(StoredPlanes::Eight)
            .or_else(sixteen)
            .unwrap_or_else(|| StoredPlanes::Floats(data.to_vec()))
    }

    fn values(self) -> Vec<f32> {
        match self {
            StoredPlanes::Eight(pixels) => pixels.into_iter().map(PixelBits::value).collect(),
            StoredPlanes::Sixteen(pixels) => pixels.into_iter().map(PixelBits::value).collect(),
            StoredPlanes::Floats(values) => values,
        }
    }

    fn count(&self) -> usize {
        match self {
            StoredPlanes::Eight(pixels) => pixels.len(),
            StoredPlanes::Sixteen(pixels) => pixels.len(),
            StoredPlanes::Floats(values) => values.len(),
        }
    }
}

read_whole!(
    PackedPhoto as PackedPhotoRecord {
        width: u32,
        height: u32,
        planes: StoredPlanes,
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
        let fits = |mask: &Mask| (mask.width(), mask.height()) == (self.width, self.height);
        self.planes.count() as u128 == values && [&self.valid, &self.empty].into_iter().flatten().all(fits)
    }

    /// The record of a photo.
    pub fn of(photo: &LoadedPhoto) -> PackedPhoto {
        let LoadedPhoto { image, valid, empty, .. } = photo;
        PackedPhoto {
            width: image.width as u32,
            height: image.height as u32,
            planes: StoredPlanes::of(&image.data),
            valid: valid.clone(),
            empty: empty.clone(),
        }
    }

    /// The photo, taken by a camera of its size; `None` where the sizes differ.
    pub fn unpack(self, camera: Camera) -> Option<LoadedPhoto> {
        let PackedPhoto { width, height, planes, valid, empty } = self;
        if (camera.width, camera.height) != (width, height) {
            return None;
        }
        let (width, height) = (width as usize, height as usize);
        let image = Image { width, height, channels: 3, data: planes.values() };
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
    /// Whether the photo is used at a long side of so many pixels much smaller than it is.
    pub(crate) fn is_larger_than(&self, long_side: u32) -> bool {
        let pixels = |camera: &Camera| u64::from(camera.width) * u64::from(camera.height);
        pixels(&self.camera) >= LARGER * pixels(&self.camera.scaled_to(long_side.max(1)))
    }

    /// Whether the photo at that size takes much longer to make of its file than to read: it is much larger, or is undistorted (half
    /// a second at 1600 px).
    pub(crate) fn is_dear_at(&self, long_side: u32) -> bool {
        self.photo.lens.is_some() || self.is_larger_than(long_side)
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
    fn every_photo_is_unpacked_as_it_was_and_takes_the_bits_of_its_pixels() {
        let eight = photo((0..18u8).map(|i| (i * 15).value()).collect());
        let sixteen = photo((0..18u16).map(|i| (i * 3800 + 7).value()).collect());
        let halves = photo((0..18u16).map(|i| (f32::from(i) + 0.5) / 65535.0).collect());
        let odd = photo(vec![f32::NAN; 18]);
        for (photo, bytes_of_value) in [(&eight, 1), (&sixteen, 2), (&halves, 4)] {
            let packed = PackedPhoto::of(photo);
            let bytes = match &packed.planes {
                StoredPlanes::Eight(pixels) => pixels.len(),
                StoredPlanes::Sixteen(pixels) => 2 * pixels.len(),
                StoredPlanes::Floats(values) => 4 * values.len(),
            };
            assert_eq!(bytes, 18 * bytes_of_value);
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
            PackedPhoto { planes: StoredPlanes::Sixteen(vec![0; 9]), ..whole.clone() },
            PackedPhoto { empty: Some(Mask::full(2, 2)), ..whole.clone() },
        ];
        assert!(forged.iter().all(|forged| again(forged).is_none()));
    }
}
