//! Images that belong to photos (masks of selections, transients): their file names, and whether their bytes are whole.

use crate::RunError;
use segwild_flow::files::name::{beside, shown};
use segwild_scene::Mask;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Longest path, in bytes, that systems take.
const LONGEST: usize = 4095;
/// Bytes that the path of a file has beside those of its folder and its name while it is written.
const ASIDE: usize = 160;

/// The file names of the images of some photos. Sub-folders of photos are sub-folders of images, and no two photos
/// share a file ([`beside`]). Earlier versions wrote all into one folder, where `a/b.jpg` and `a_b.jpg` shared a file.
/// Such a file is found where only one photo can have written it.
pub(crate) struct ImageFiles {
    names: Vec<String>,
    before: Vec<Option<String>>,
}

impl ImageFiles {
    /// The images of photos, by the photos' names in the scene.
    pub fn of<'a>(photos: impl Iterator<Item = &'a str> + Clone) -> ImageFiles {
        let names = beside(photos.clone(), "png");
        let old = flattened(photos);
        let mut taken: BTreeMap<String, usize> = BTreeMap::new();
        for name in names.iter().chain(&old) {
            *taken.entry(name.to_lowercase()).or_default() += 1;
        }
        let before = old.into_iter().map(|old| (taken[&old.to_lowercase()] == 1).then_some(old)).collect();
        ImageFiles { names, before }
    }

    /// Refuses a folder in which an image would have a longer path than systems take. Checked before anything is
    /// computed.
    ///
    /// # Errors
    /// Names the image.
    pub fn fit(&self, folder: &Path) -> Result<(), RunError> {
        let whole = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
        let before = whole.as_os_str().len() + ASIDE;
        match self.names.iter().find(|name| before + name.len() > LONGEST) {
            None => Ok(()),
            Some(name) => {
                let start: String = name.chars().take(60).collect();
                Err(RunError::Request(format!(
                    "the image {start}.. of a photo would have a path of {} bytes, and systems take {LONGEST}: choose a folder \
                     with a shorter path, or call the photos and their folders by shorter names",
                    before + name.len()
                )))
            }
        }
    }

    /// The name under which a photo's image is written.
    pub fn name(&self, photo: usize) -> &str {
        &self.names[photo]
    }

    /// The names of all images, in order of the photos.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The name that an earlier version gave it, if no other photo can have had it.
    pub fn name_before(&self, photo: usize) -> Option<&str> {
        self.before[photo].as_deref()
    }

    /// The path of a photo's image in a folder: under its name, else under that of an earlier version.
    pub fn find(&self, folder: &Path, photo: usize) -> PathBuf {
        let now = folder.join(&self.names[photo]);
        match &self.before[photo] {
            Some(before) if !now.exists() && folder.join(before).is_file() => folder.join(before),
            _ => now,
        }
    }
}

/// Whether one size is the other scaled: either side of either may be rounded by a pixel.
fn same_shape(a: (u32, u32), b: (u32, u32)) -> bool {
    let ((w, h), (pw, ph)) = (pair(a), pair(b));
    w > 0.0 && h > 0.0 && (w * ph - h * pw).abs() <= 1.01 * (w.max(h) + pw.max(ph))
}

/// A mask image of another shape than its photo.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{} x {} pixels, which does not fit {photo}'s {} x {}", mask_size.0, mask_size.1, size.0, size.1)]
pub(crate) struct OtherShape {
    /// Width and height of the mask in pixels.
    mask_size: (u32, u32),
    /// What the photo is called.
    photo: String,
    /// Its width and height.
    size: (u32, u32),
}

/// Refuses a mask of another shape than its photo's. `photo` is what the error calls the photo, `size` its width and height in
/// pixels.
///
/// # Errors
/// When neither size is the other scaled.
pub(crate) fn check_shape(mask: &Mask, photo: &str, size: (u32, u32)) -> Result<(), OtherShape> {
    let mask_size = (mask.width(), mask.height());
    match same_shape(mask_size, size) {
        true => Ok(()),
        false => Err(OtherShape { mask_size, photo: photo.to_owned(), size }),
    }
}

fn pair((w, h): (u32, u32)) -> (f64, f64) {
    (f64::from(w), f64::from(h))
}

/// The names that earlier versions gave: sub-folders flattened, the whole name where two photos have one stem.
fn flattened<'a>(photos: impl Iterator<Item = &'a str> + Clone) -> Vec<String> {
    let flat = |photo: &str| photo.replace(['/', '\\'], "_");
    let stem = |photo: &str| {
        let flat = flat(photo);
        flat.rsplit_once('.').map_or(flat.clone(), |(stem, _)| stem.to_owned())
    };
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    photos.clone().for_each(|photo| *seen.entry(stem(photo)).or_default() += 1);
    let name = |photo: &str| if seen[&stem(photo)] > 1 { flat(photo) } else { stem(photo) };
    photos.map(|photo| format!("{}.png", name(photo))).collect()
}

/// The first bytes of a PNG.
const PNG: [u8; 8] = *b"\x89PNG\r\n\x1a\n";
/// Bytes of a chunk beside its content: length, kind, check sum.
const AROUND: usize = 12;

/// The check sum of a PNG's chunks.
fn crc(bytes: &[u8]) -> u32 {
    let step = |crc: u32, _| if crc & 1 == 1 { 0xedb8_8320 ^ (crc >> 1) } else { crc >> 1 };
    !bytes.iter().fold(u32::MAX, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), step))
}

/// The chunks of a PNG, kind and content; the last is an error where the file is damaged.
fn chunks(png: &[u8]) -> impl Iterator<Item = Result<(&[u8], &[u8]), &'static str>> {
    let mut rest = png.get(PNG.len()..).unwrap_or_default();
    let mut over = false;
    std::iter::from_fn(move || {
        if over {
            return None;
        }
        let number = |bytes: &[u8]| bytes.try_into().map_or(0, u32::from_be_bytes);
        let length = rest.get(..4).map_or(0, number) as usize;
        let Some(chunk) = length.checked_add(AROUND).and_then(|whole| rest.get(..whole)) else {
            over = true;
            return Some(Err("it is cut short"));
        };
        rest = &rest[chunk.len()..];
        let (covered, sum) = chunk[4..].split_at(length + 4);
        let (kind, content) = covered.split_at(4);
        let whole = crc(covered) == number(sum);
        over = !whole || kind == b"IEND";
        Some(if whole { Ok((kind, content)) } else { Err("a check sum does not fit its bytes") })
    })
}

/// What is wrong with the bytes of a damaged PNG; `None` for one that is whole, and for files of other kinds.
pub(crate) fn damage(bytes: &[u8]) -> Option<&'static str> {
    if bytes.is_empty() {
        return Some("it is empty");
    }
    if !bytes.starts_with(&PNG) {
        return None;
    }
    chunks(bytes).find_map(Result::err)
}

/// Puts a comment into a PNG.
pub(crate) fn with_comment(png: &[u8], comment: &str) -> Vec<u8> {
    // The last chunk is empty.
    let (before, end) = png.split_at(png.len().saturating_sub(AROUND));
    let covered = [b"tEXtComment\0", comment.as_bytes()].concat();
    let length = (covered.len() - 4) as u32;
    [before, &length.to_be_bytes(), &covered, &crc(&covered).to_be_bytes(), end].concat()
}

/// The comment in a PNG, if it has one.
pub(crate) fn comment(png: &[u8]) -> Option<String> {
    if !png.starts_with(&PNG) {
        return None;
    }
    let text = chunks(png)
        .filter_map(Result::ok)
        .find_map(|(kind, content)| content.strip_prefix(b"Comment\0").filter(|_| kind == b"tEXt"))?;
    Some(shown(&String::from_utf8_lossy(text)).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_that_an_earlier_version_left_are_found_where_one_photo_alone_can_have_left_them() {
        let dir = tempfile::tempdir().unwrap();
        let photos = ["a/x.jpg", "a/b.jpg", "a_b.jpg", "y.jpg"];
        let files = ImageFiles::of(photos.into_iter());
        assert_eq!(files.names(), ["a/x.png", "a/b.png", "a_b.png", "y.png"]);
        for old in ["a_x.png", "a_b.png", "y.png"] {
            std::fs::write(dir.path().join(old), old).unwrap();
        }
        let found =
            |photo| files.find(dir.path(), photo).strip_prefix(dir.path()).unwrap().display().to_string();
        assert_eq!([0, 1, 2, 3].map(found), ["a_x.png", "a/b.png", "a_b.png", "y.png"]);
        std::fs::create_dir(dir.path().join("a")).unwrap();
        std::fs::write(dir.path().join("a/x.png"), "new").unwrap();
        assert_eq!(found(0), "a/x.png");
    }

    #[test]
    fn a_path_that_no_system_takes_is_refused_before_it_is_written() {
        let deep = format!("{}b.jpg", "folder/".repeat(500));
        let files = ImageFiles::of(["a.jpg", deep.as_str()].into_iter());
        assert!(files.fit(Path::new("/run")).is_ok());
        let message = files.fit(Path::new(&format!("/{}", "run/".repeat(120)))).unwrap_err().to_string();
        assert!(
            message.contains("folder/folder") && message.contains("4095") && message.len() < 400,
            "{message}"
        );
    }

    #[test]
    fn every_flipped_bit_in_an_image_is_found() {
        let png = with_comment(&Mask::from_fn(19, 7, |x, y| x > 2 * y).png().unwrap(), "made 0123");
        assert_eq!((damage(&png), comment(&png).as_deref()), (None, Some("made 0123")));
        for bit in 8 * PNG.len()..8 * png.len() {
            let mut flipped = png.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(damage(&flipped).is_some(), "bit {bit}");
        }
        for length in 0..png.len() {
            assert!(length > 0 && length < PNG.len() || damage(&png[..length]).is_some(), "{length} bytes");
        }
    }

    #[test]
    fn a_comment_changes_no_pixel() {
        let dir = tempfile::tempdir().unwrap();
        let (mask, file) = (Mask::from_fn(9, 5, |x, y| (x + y) % 2 == 0), dir.path().join("a.png"));
        std::fs::write(&file, with_comment(&mask.png().unwrap(), "made")).unwrap();
        assert_eq!(Mask::read_png(&file).unwrap(), mask);
    }

    #[test]
    fn a_mask_turned_by_a_quarter_does_not_fit_and_one_rounded_when_it_was_scaled_does() {
        for fits in [(160, 107), (1600, 1067), (3200, 2134), (80, 53), (80, 54)] {
            assert!(same_shape(fits, (1600, 1067)), "{fits:?}");
        }
        for other in [(107, 160), (1067, 1600), (1600, 1600), (1600, 1200), (0, 0)] {
            assert!(!same_shape(other, (1600, 1067)), "{other:?}");
        }
    }
}
