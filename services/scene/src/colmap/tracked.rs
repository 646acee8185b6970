//! The features of a reconstruction that its points name.

use super::records::PointRecord;
use std::collections::HashMap;

/// Pixels of the features that points name, by the id of an image and the index of a feature in it.
#[derive(Debug)]
pub(crate) struct TrackedPixels(HashMap<u32, ImageFeatures>);

/// The named features of an image.
#[derive(Debug, Default)]
struct ImageFeatures {
    /// Their indices, ascending.
    indices: Vec<u32>,
    /// As many of their pixels as were read, in the order of the indices.
    pixels: Vec<[f64; 2]>,
    /// Images of this id that have begun.
    images: usize,
}

impl TrackedPixels {
    /// The features that these points name, none of them read.
    pub fn of(points: &[PointRecord]) -> TrackedPixels {
        let mut images: HashMap<u32, ImageFeatures> = HashMap::new();
        for &(image, index) in points.iter().flat_map(|point| &point.track) {
            images.entry(image).or_default().indices.push(index);
        }
        for features in images.values_mut() {
            features.indices.sort_unstable();
            features.indices.dedup();
            features.indices.shrink_to_fit();
            features.pixels.reserve_exact(features.indices.len());
        }
        TrackedPixels(images)
    }

    /// Takes the pixel of a feature that a point names. An image's features come in order; of two images with one id the first
    /// that has features counts.
    pub fn put(&mut self, image: u32, index: u32, pixel: [f64; 2]) {
        let Some(features) = self.0.get_mut(&image) else { return };
        features.images += usize::from(index == 0);
        if features.images == 1 && features.indices.get(features.pixels.len()) == Some(&index) {
            features.pixels.push(pixel);
        }
    }

    /// The pixel of a feature; `None` where the image has no such feature.
    pub fn get(&self, image: u32, index: u32) -> Option<[f64; 2]> {
        let ImageFeatures { indices, pixels, .. } = self.0.get(&image)?;
        pixels.get(indices.binary_search(&index).ok()?).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn named_features_are_found_again_and_of_two_images_with_one_id_the_first_counts() {
        let point = |track: &[(u32, u32)]| PointRecord {
            id: 1,
            position: [0.0; 3],
            colour: [0; 3],
            error: 0.0,
            track: track.to_vec(),
        };
        let mut pixels =
            TrackedPixels::of(&[point(&[(7, 3), (7, 1), (8, 0)]), point(&[(7, 1), (7, 9), (9, 2)])]);
        for (image, offset, features) in [(7, 0.0, 5), (8, 100.0, 5), (7, 200.0, 10)] {
            for index in 0..features {
                pixels.put(image, index, [f64::from(index) + offset, 0.5]);
            }
        }
        assert_eq!([1, 3].map(|index| pixels.get(7, index)), [Some([1.0, 0.5]), Some([3.0, 0.5])]);
        assert_eq!(pixels.get(8, 0), Some([100.0, 0.5]));
        // No point names it; the image has fewer features; the image is not there; it is no image of any point.
        for (image, index) in [(7, 2), (7, 9), (9, 2), (1, 1)] {
            assert_eq!(pixels.get(image, index), None, "{image}, {index}");
        }
    }
}
