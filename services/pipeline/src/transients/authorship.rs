//! Who wrote the mask image of a photo's transients: this program, a person, or a damaged disk.
//!
//! This program writes the hash of the pixels into a comment of the image, and into `made.json` as well. If one of the
//! two is damaged, the other still shows that the image is not a person's. An image that cannot be read, or whose check
//! sums do not fit, is damaged: it is moved aside, where a person can look at it, and made again.

use crate::artifacts::images::{ImageFiles, comment, damage, with_comment};
use crate::{RunError, RunFolder};
use segwild_flow::{FileError, files};
use segwild_scene::{Mask, Scene, SceneError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The folder of the mask images in the run folder, and the list of what this program has written there.
pub(crate) const FOLDER: &str = "transients";
pub(crate) const MADE: &str = "transients/made.json";
/// Start of the comment in an image of this program; the hash of its pixels follows.
const SIGN: &str = "made by segwild, pixels ";

/// The mask images of a scene's photos.
pub(super) fn image_files(scene: &Scene) -> ImageFiles {
    ImageFiles::of(scene.views.iter().map(|v| v.name.as_str()))
}

/// The mask image that this program has written of one photo.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct WrittenMask {
    /// The key of what it was made from.
    pub key: String,
    /// Hashes of the pixels written last, and of those before: either may be in the file when a run is killed.
    pub pixels: Vec<String>,
    /// How the trained scene fits the photo; `None` where it was not compared.
    #[serde(default)]
    pub fit: Option<TrainPhotoFit>,
}

/// How the trained scene fits a photo.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(crate) struct TrainPhotoFit {
    /// PSNR in dB over every pixel that is not sky and that no person has masked.
    pub psnr: f32,
    /// Share of the photo in its transient mask.
    pub transient: f32,
}

/// How the trained scene fits the photos that it was trained on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TrainFit {
    /// Mean PSNR in dB over every pixel that is not sky and that no person has masked.
    pub psnr: f32,
    /// Mean share of a photo that was found to be transient.
    pub transient: f32,
    /// Photos compared.
    pub photos: usize,
}

impl TrainFit {
    /// The fit of single photos, by the names of their transient masks.
    pub(crate) fn by_mask(folder: &RunFolder) -> BTreeMap<String, TrainPhotoFit> {
        let written = WrittenMasks::of(folder).0.into_iter();
        written.filter_map(|(name, mask)| Some((name, mask.fit?))).collect()
    }

    /// Of a run whose transient masks are made; `None` before.
    pub fn of(folder: &RunFolder) -> Option<TrainFit> {
        let fits: Vec<TrainPhotoFit> = TrainFit::by_mask(folder).into_values().collect();
        let mean = |of: fn(&TrainPhotoFit) -> f32| fits.iter().map(of).sum::<f32>() / fits.len() as f32;
        (!fits.is_empty()).then(|| TrainFit {
            psnr: mean(|f| f.psnr),
            transient: mean(|f| f.transient),
            photos: fits.len(),
        })
    }

    /// The fit in words.
    pub fn in_words(&self) -> String {
        let share = 100.0 * self.transient;
        format!(
            "PSNR {:.2} dB over all pixels but the sky, transients included; {share:.1} % of the pixels are taken for \
             transients",
            self.psnr
        )
    }
}

/// Hash of a mask's size and pixels: an editor may write the same pixels in other bytes.
pub(crate) fn pixel_hash(mask: &Mask) -> String {
    let mut hasher = blake3::Hasher::new();
    hasher.update(format!("{} {}", mask.width(), mask.height()).as_bytes());
    for (x, y) in mask.pixels() {
        hasher.update(&x.to_le_bytes());
        hasher.update(&y.to_le_bytes());
    }
    hasher.finalize().to_hex()[..32].to_owned()
}

/// The mask image of a photo in the run folder.
#[derive(Debug)]
pub(crate) enum MaskImage {
    /// There is none.
    Missing,
    /// This program wrote it; the hash of its pixels.
    OfProgram(String),
    /// A person wrote or changed it.
    OfPerson(Mask),
    /// It is damaged; what is wrong with it.
    Damaged(String),
}

/// The content of `made.json`, by the name of the image.
pub(crate) struct WrittenMasks(BTreeMap<String, WrittenMask>);

impl WrittenMasks {
    /// Reads the list of a run. It is empty where the file is missing or damaged: the comments of the images then serve.
    pub fn of(folder: &RunFolder) -> WrittenMasks {
        WrittenMasks(folder.read_json(MADE).unwrap_or_default())
    }

    /// What this program has written of a photo.
    pub fn of_photo(&self, files: &ImageFiles, photo: usize) -> Option<&WrittenMask> {
        let before = || files.name_before(photo).and_then(|before| self.0.get(before));
        self.0.get(files.name(photo)).or_else(before)
    }
}

/// Decides who wrote a mask image in the run folder.
///
/// # Errors
/// When the file is there and the system does not let it be read.
pub(crate) fn inspect(file: &Path, written: Option<&WrittenMask>) -> Result<MaskImage, FileError> {
    if !file.is_file() {
        return Ok(MaskImage::Missing);
    }
    let bytes = files::read_plain(file).map_err(|e| FileError::new("read", file, e))?;
    if let Some(reason) = damage(&bytes) {
        return Ok(MaskImage::Damaged(reason.into()));
    }
    let mask = match Mask::read_png(file) {
        Ok(mask) => mask,
        Err(SceneError::Invalid { reason, .. }) => return Ok(MaskImage::Damaged(reason)),
        Err(other) => return Ok(MaskImage::Damaged(other.to_string())),
    };
    let hash = pixel_hash(&mask);
    let signed = || comment(&bytes).is_some_and(|comment| comment.strip_prefix(SIGN) == Some(&hash));
    if written.is_some_and(|written| written.pixels.contains(&hash)) || signed() {
        return Ok(MaskImage::OfProgram(hash));
    }
    Ok(MaskImage::OfPerson(mask))
}

/// What is wrong with a mask image, by its bytes alone; `None` where there is none or it is whole.
pub(crate) fn damage_of(file: &Path) -> Option<String> {
    match files::read_plain(file) {
        Ok(bytes) => damage(&bytes).map(str::to_owned),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        Err(error) => Some(error.to_string()),
    }
}

impl RunFolder {
    /// Checks the transient mask image of every photo. Returns how many there are, and the damaged ones with the reason.
    ///
    /// # Errors
    /// When the list of photos cannot be read.
    pub fn verify_transient_masks(&self) -> Result<(usize, Vec<(PathBuf, String)>), RunError> {
        if !self.path().join("scene.json").exists() {
            return Ok((0, Vec::new())); // the run has not started
        }
        let (photos, own) = (self.intake()?.photos, self.path().join(FOLDER));
        let files = ImageFiles::of(photos.iter().map(String::as_str));
        let written = WrittenMasks::of(self);
        let (mut count, mut damaged) = (0, Vec::new());
        for photo in 0..photos.len() {
            let file = files.find(&own, photo);
            match inspect(&file, written.of_photo(&files, photo)) {
                Ok(MaskImage::Missing) => continue,
                Ok(MaskImage::Damaged(reason)) => damaged.push((file, reason)),
                Err(error) => damaged.push((file, error.to_string())),
                Ok(MaskImage::OfProgram(_) | MaskImage::OfPerson(_)) => {}
            }
            count += 1;
        }
        Ok((count, damaged))
    }
}

/// Writes a mask image, with the hash of its pixels in a comment.
pub(crate) fn write(file: &Path, mask: &Mask) -> Result<(), RunError> {
    let png = mask.png()?;
    Ok(files::write_atomic(file, &with_comment(&png, &format!("{SIGN}{}", pixel_hash(mask))))?)
}

/// Renames damaged images to `NAME.damaged` in their folder. Returns a sentence for each.
pub(crate) fn put_aside(damaged: &[(PathBuf, String)]) -> Result<Vec<String>, RunError> {
    damaged.iter().map(|(file, reason)| put_one_aside(file, reason)).collect()
}

fn put_one_aside(file: &Path, reason: &str) -> Result<String, RunError> {
    let numbered = |n: u32| {
        let mut name = file.file_name().unwrap_or_default().to_owned();
        name.push(if n == 0 { ".damaged".to_owned() } else { format!(".damaged-{n}") });
        file.with_file_name(name)
    };
    // An image that was put aside before stays: it may be all that is left of a person's work.
    let aside = (0..).map(numbered).find(|aside| !aside.exists()).unwrap_or_default();
    std::fs::rename(file, &aside).map_err(|e| FileError::new("put aside", file, e))?;
    Ok(format!(
        "{} is damaged ({reason}): it is put aside as {} and made again",
        file.display(),
        aside.file_name().unwrap_or_default().display()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn there() -> (tempfile::TempDir, PathBuf, Mask) {
        let dir = tempfile::tempdir().unwrap();
        let (file, mask) = (dir.path().join("a.png"), Mask::from_fn(13, 7, |x, y| (x + y) % 3 == 0));
        write(&file, &mask).unwrap();
        (dir, file, mask)
    }

    #[test]
    fn an_image_of_this_program_is_known_without_the_list_and_one_with_other_pixels_is_a_persons() {
        let (_dir, file, mask) = there();
        assert!(
            matches!(inspect(&file, None).unwrap(), MaskImage::OfProgram(hash) if hash == pixel_hash(&mask))
        );
        // An editor may keep the comment.
        let edited = with_comment(&mask.not().png().unwrap(), &format!("{SIGN}{}", pixel_hash(&mask)));
        std::fs::write(&file, edited).unwrap();
        assert!(matches!(inspect(&file, None).unwrap(), MaskImage::OfPerson(m) if m == mask.not()));
    }

    #[test]
    fn a_damaged_image_never_passes_for_a_persons() {
        let (_dir, file, _) = there();
        let whole = std::fs::read(&file).unwrap();
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x10;
            std::fs::write(&file, &bytes).unwrap();
            assert!(matches!(inspect(&file, None).unwrap(), MaskImage::Damaged(_)), "byte {at}");
            std::fs::write(&file, &whole[..at]).unwrap();
            assert!(matches!(inspect(&file, None).unwrap(), MaskImage::Damaged(_)), "{at} bytes");
        }
    }

    #[test]
    fn what_was_put_aside_before_is_not_overwritten() {
        let (dir, file, _) = there();
        for text in ["first", "second"] {
            std::fs::write(&file, text).unwrap();
            let messages = put_aside(&[(file.clone(), "it is cut short".into())]).unwrap();
            assert!(messages[0].contains("a.png is damaged (it is cut short)"), "{messages:?}");
        }
        let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
        assert_eq!([read("a.png.damaged"), read("a.png.damaged-1")], ["first", "second"]);
        assert!(!file.exists());
    }

    #[test]
    fn a_flipped_bit_in_an_image_is_found_without_decoding_it_and_by_the_check_of_a_whole_run() {
        let dir = tempfile::tempdir().unwrap();
        let run = RunFolder::create(dir.path()).unwrap();
        assert_eq!(run.verify_transient_masks().unwrap().0, 0);
        let frame = serde_json::json!({ "origin": [0.0, 0.0, 0.0], "scale": 1.0 });
        let intake = serde_json::json!({
            "scene": dir.path(), "photos": ["a.jpg", "b.jpg"], "held_out": [], "skipped": [], "points": 0, "frame": frame
        });
        run.write_json("scene.json", &intake).unwrap();
        let mask = Mask::from_fn(13, 7, |x, y| (x + y) % 3 == 0);
        let [a, b] = ["a.png", "b.png"].map(|name| dir.path().join(FOLDER).join(name));
        write(&a, &mask).unwrap();
        write(&b, &mask).unwrap();
        let mut bytes = std::fs::read(&b).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(&b, bytes).unwrap();
        assert!(damage_of(&a).is_none() && damage_of(&b).is_some());
        let (count, damaged) = run.verify_transient_masks().unwrap();
        assert_eq!((count, damaged.len(), &damaged[0].0), (2, 1, &b));
    }

    #[test]
    fn the_same_pixels_in_another_file_are_the_same_mask() {
        let dir = tempfile::tempdir().unwrap();
        let mask = Mask::from_fn(13, 7, |x, y| (x + y) % 3 == 0);
        // An editor writes colours and other bytes.
        let image = segwild_scene::Image {
            width: 13,
            height: 7,
            channels: 3,
            data: (0..3 * 91).map(|i| f32::from(u8::from(mask.index(i % 91)))).collect(),
        };
        let file = dir.path().join("a.png");
        image.write_png(&file).unwrap();
        assert_eq!(pixel_hash(&Mask::read_png(&file).unwrap()), pixel_hash(&mask));
        assert_ne!(pixel_hash(&mask.not()), pixel_hash(&mask));
    }
}
