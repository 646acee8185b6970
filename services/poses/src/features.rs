//! The step `features`: which photos share a lens, and how much memory their features take.

use crate::database::ImageRow;
use crate::{CameraSharing, PoseLimits};
use segwild_scene::UnposedPhoto;
use std::collections::BTreeMap;

/// Bytes that COLMAP's extractor takes per pixel of a photo on each thread: measured with COLMAP 3.8 without CUDA at 1600 and
/// 3200 px (308 and 293).
const BYTES_PER_PIXEL: f64 = 310.0;
/// Bytes per pixel of a decoded photo before it is scaled down, which waits for the extractor.
const BYTES_DECODED: f64 = 4.0;

/// Photos whose features are computed by one call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct LensGroup<'a> {
    /// Whether they share one lens.
    pub shared: bool,
    /// Their names, in order.
    pub names: Vec<&'a str>,
}

/// What photos have in common that share a lens. COLMAP refuses one lens for photos of several sizes.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct LensKey {
    size: (u32, u32),
    /// The camera and the bits of its focal length; `None` where all photos share one.
    camera: Option<(String, u64)>,
}

impl LensKey {
    /// The key of a photo; `None` where it shares its lens with no other.
    fn of(photo: &UnposedPhoto, sharing: CameraSharing, of_video: bool) -> Option<LensKey> {
        let size = photo.size;
        let one = LensKey { size, camera: None };
        match sharing {
            CameraSharing::Each => None,
            CameraSharing::One => Some(one),
            CameraSharing::Auto if of_video => Some(one),
            CameraSharing::Auto => {
                let camera = photo.camera.as_ref()?;
                let model = format!("{} {}", camera.make, camera.model);
                Some(LensKey { size, camera: Some((model, camera.focal_mm.to_bits())) })
            }
        }
    }
}

/// Photos by the lens that they share; those that share none are one group.
pub(crate) fn lens_groups<'a>(
    photos: &'a [UnposedPhoto],
    sharing: CameraSharing,
    of_video: bool,
) -> Vec<LensGroup<'a>> {
    let mut groups: BTreeMap<LensKey, Vec<&str>> = BTreeMap::new();
    let mut alone = Vec::new();
    for photo in photos {
        let name = photo.name.as_str();
        match LensKey::of(photo, sharing, of_video) {
            Some(key) => groups.entry(key).or_default().push(name),
            None => alone.push(name),
        }
    }
    let (several, single): (Vec<_>, Vec<_>) = groups.into_values().partition(|names| names.len() > 1);
    alone.extend(single.into_iter().flatten());
    alone.sort_unstable();
    let mut groups: Vec<LensGroup<'_>> =
        several.into_iter().map(|names| LensGroup { shared: true, names }).collect();
    if !alone.is_empty() {
        groups.push(LensGroup { shared: false, names: alone });
    }
    groups
}

impl LensGroup<'_> {
    /// Those of its photos that have no features yet.
    pub fn left(&self, images: &BTreeMap<String, ImageRow>) -> Vec<&str> {
        let has = |name: &&&str| images.get(**name).is_some_and(|row| row.features.is_some());
        self.names.iter().filter(|name| !has(name)).copied().collect()
    }

    /// The camera that its photos share already.
    pub fn camera(&self, images: &BTreeMap<String, ImageRow>) -> Option<i64> {
        let known = self.names.iter().find_map(|name| Some(images.get(*name)?.camera));
        known.filter(|_| self.shared)
    }
}

/// Threads and the long side of photos with which the extractor stays within the memory that it may take.
pub(crate) fn within_memory(photos: &[UnposedPhoto], limits: &PoseLimits, size: u32) -> (usize, u32) {
    let need = |size: u32| photos.iter().map(|photo| bytes(photo.size, size)).fold(1.0, f64::max);
    let memory = limits.memory as f64;
    let mut size = size;
    while need(size) > memory && size > LEAST_SIZE {
        size = (size * 3 / 4).max(LEAST_SIZE);
    }
    let threads = (memory / need(size)) as usize;
    (threads.clamp(1, limits.threads.max(1)), size)
}

/// Photos are not scaled down further, however short memory is: too few features would be left.
const LEAST_SIZE: u32 = 640;

fn bytes((width, height): (u32, u32), size: u32) -> f64 {
    let whole = f64::from(width) * f64::from(height);
    let scale = (f64::from(size) / f64::from(width.max(height).max(1))).min(1.0);
    whole * (BYTES_PER_PIXEL * scale * scale + BYTES_DECODED)
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::ExifCamera;

    fn photo(name: &str, size: (u32, u32), camera: Option<(&str, f64)>) -> UnposedPhoto {
        let camera =
            camera.map(|(model, focal_mm)| ExifCamera { make: "m".into(), model: model.into(), focal_mm });
        UnposedPhoto { name: name.into(), size, camera }
    }

    #[test]
    fn photos_of_one_camera_at_one_focal_length_share_a_lens() {
        let photos = [
            photo("a", (40, 30), Some(("x", 5.0))),
            photo("b", (40, 30), Some(("x", 5.0))),
            photo("c", (40, 30), Some(("x", 7.0))),
            photo("d", (30, 40), Some(("x", 5.0))),
            photo("e", (40, 30), None),
        ];
        let names = |sharing, video| {
            let groups = lens_groups(&photos, sharing, video);
            groups.into_iter().map(|g| (g.shared, g.names.concat())).collect::<Vec<_>>()
        };
        let all = |text: &[(bool, &str)]| text.iter().map(|(s, t)| (*s, (*t).to_owned())).collect::<Vec<_>>();
        assert_eq!(names(CameraSharing::Auto, false), all(&[(true, "ab"), (false, "cde")]));
        assert_eq!(names(CameraSharing::Auto, true), all(&[(true, "abce"), (false, "d")]));
        assert_eq!(names(CameraSharing::One, false), all(&[(true, "abce"), (false, "d")]));
        assert_eq!(names(CameraSharing::Each, true), all(&[(false, "abcde")]));
    }

    #[test]
    fn the_extractor_takes_fewer_threads_before_it_takes_smaller_photos() {
        let photos = [photo("a", (4000, 3000), None)];
        let limit = |mib: u64| within_memory(&photos, &PoseLimits { threads: 8, memory: mib << 20 }, 3200);
        assert_eq!(limit(64 << 10), (8, 3200));
        assert_eq!(limit(6 << 10), (2, 3200));
        let (threads, size) = limit(1 << 10);
        assert!(threads == 1 && (LEAST_SIZE..3200).contains(&size), "{threads} threads, {size} px");
        assert_eq!(limit(1), (1, LEAST_SIZE));
    }
}
