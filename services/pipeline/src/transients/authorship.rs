//! Who made a picture of a photo's transients: this program, a person, or a damaged disk.
//!
//! A picture says itself that this program made it, with the hash of its pixels, and `made.json` says it once more: a
//! damaged one of the two makes no picture a person's. One that cannot be read, or whose check sums do not fit, is nobody's
//! work: it is put aside, where a person can look at it, and made again.

use crate::images::{Pictures, comment, damage, with_comment};
use crate::{RunError, RunFolder};
use segwild_flow::{FileError, files};
use segwild_scene::{Mask, SceneError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where the pictures are in the run folder, and what says who made them.
pub(crate) const FOLDER: &str = "transients";
pub(crate) const MADE: &str = "transients/made.json";
/// What the comment in a picture of this program begins with; the hash of its pixels follows.
const SIGN: &str = "made by segwild, pixels ";

/// What this program has made of one photo.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Made {
    /// The name of what it was made from.
    pub key: String,
    /// The pixels written last, and those before: either may be in the file when a run is killed.
    pub pixels: Vec<String>,
}

/// Hash of a mask's size and pixels: an editor may write the same pixels in other bytes.
pub(crate) fn pixels(mask: &Mask) -> String {
    let mut hasher = blake3::Hasher::new();
    hasher.update(format!("{} {}", mask.width(), mask.height()).as_bytes());
    for (x, y) in mask.pixels() {
        hasher.update(&x.to_le_bytes());
        hasher.update(&y.to_le_bytes());
    }
    hasher.finalize().to_hex()[..32].to_owned()
}

/// A picture in the run's own folder.
#[derive(Debug)]
pub(crate) enum Picture {
    /// There is none.
    None,
    /// This program's, by the hash of its pixels.
    Ours(String),
    /// A person's.
    Theirs(Mask),
    /// Nobody's work: what is wrong with it.
    Damaged(String),
}

/// What `made.json` says, by the name of the picture.
pub(crate) struct Ledger(BTreeMap<String, Made>);

impl Ledger {
    /// That of a run; empty where it is not there or damaged, for the pictures say it as well.
    pub fn of(folder: &RunFolder) -> Ledger {
        Ledger(folder.read_json(MADE).unwrap_or_default())
    }

    /// What was made of a photo.
    pub fn of_photo(&self, pictures: &Pictures, photo: usize) -> Option<&Made> {
        let before = || pictures.name_before(photo).and_then(|before| self.0.get(before));
        self.0.get(pictures.name(photo)).or_else(before)
    }
}

/// Looks at a photo's picture in the run's own folder.
///
/// # Errors
/// When it is there and the system does not let it be read.
pub(crate) fn look_at(file: &Path, made: Option<&Made>) -> Result<Picture, FileError> {
    if !file.is_file() {
        return Ok(Picture::None);
    }
    let bytes = files::read_plain(file).map_err(|e| FileError::new("read", file, e))?;
    if let Some(reason) = damage(&bytes) {
        return Ok(Picture::Damaged(reason.into()));
    }
    let mask = match Mask::read_png(file) {
        Ok(mask) => mask,
        Err(SceneError::Invalid { reason, .. }) => return Ok(Picture::Damaged(reason)),
        Err(other) => return Ok(Picture::Damaged(other.to_string())),
    };
    let hash = pixels(&mask);
    let signed = || comment(&bytes).is_some_and(|said| said.strip_prefix(SIGN) == Some(&hash));
    if made.is_some_and(|made| made.pixels.contains(&hash)) || signed() {
        return Ok(Picture::Ours(hash));
    }
    Ok(Picture::Theirs(mask))
}

/// What is wrong with a photo's picture, by its bytes alone; `None` where there is none or it is whole.
pub(crate) fn damage_of(file: &Path) -> Option<String> {
    match files::read_plain(file) {
        Ok(bytes) => damage(&bytes).map(str::to_owned),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        Err(error) => Some(error.to_string()),
    }
}

impl RunFolder {
    /// Looks at the picture of every photo's transients: how many there are, and those that are damaged, with the reason.
    ///
    /// # Errors
    /// When the list of photos cannot be read.
    pub fn verify_pictures(&self) -> Result<(usize, Vec<(PathBuf, String)>), RunError> {
        if !self.path().join("scene.json").exists() {
            return Ok((0, Vec::new())); // the run has not begun
        }
        let (photos, own) = (self.intake()?.photos, self.path().join(FOLDER));
        let pictures = Pictures::of(photos.iter().map(String::as_str));
        let ledger = Ledger::of(self);
        let (mut count, mut damaged) = (0, Vec::new());
        for photo in 0..photos.len() {
            let file = pictures.find(&own, photo);
            match look_at(&file, ledger.of_photo(&pictures, photo)) {
                Ok(Picture::None) => continue,
                Ok(Picture::Damaged(reason)) => damaged.push((file, reason)),
                Err(error) => damaged.push((file, error.to_string())),
                Ok(Picture::Ours(_) | Picture::Theirs(_)) => {}
            }
            count += 1;
        }
        Ok((count, damaged))
    }
}

/// Writes a picture of this program.
pub(crate) fn write(file: &Path, mask: &Mask) -> Result<(), RunError> {
    let png = mask.png()?;
    Ok(files::write_atomic(file, &with_comment(&png, &format!("{SIGN}{}", pixels(mask))))?)
}

/// Puts damaged pictures aside, beside where they were; says so, a sentence each.
pub(crate) fn put_aside(damaged: &[(PathBuf, String)]) -> Result<Vec<String>, RunError> {
    damaged.iter().map(|(file, reason)| put_one_aside(file, reason)).collect()
}

fn put_one_aside(file: &Path, reason: &str) -> Result<String, RunError> {
    let numbered = |n: u32| {
        let mut name = file.file_name().unwrap_or_default().to_owned();
        name.push(if n == 0 { ".damaged".to_owned() } else { format!(".damaged-{n}") });
        file.with_file_name(name)
    };
    // One that was put aside before stays: it may be all that is left of a person's work.
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
    fn a_picture_of_this_program_is_known_without_the_list_and_one_with_other_pixels_is_a_persons() {
        let (_dir, file, mask) = there();
        assert!(matches!(look_at(&file, None).unwrap(), Picture::Ours(hash) if hash == pixels(&mask)));
        // An editor may keep the comment.
        let edited = with_comment(&mask.not().png().unwrap(), &format!("{SIGN}{}", pixels(&mask)));
        std::fs::write(&file, edited).unwrap();
        assert!(matches!(look_at(&file, None).unwrap(), Picture::Theirs(m) if m == mask.not()));
    }

    #[test]
    fn a_damaged_picture_never_passes_for_a_persons() {
        let (_dir, file, _) = there();
        let whole = std::fs::read(&file).unwrap();
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x10;
            std::fs::write(&file, &bytes).unwrap();
            assert!(matches!(look_at(&file, None).unwrap(), Picture::Damaged(_)), "byte {at}");
            std::fs::write(&file, &whole[..at]).unwrap();
            assert!(matches!(look_at(&file, None).unwrap(), Picture::Damaged(_)), "{at} bytes");
        }
    }

    #[test]
    fn what_was_put_aside_before_is_not_overwritten() {
        let (dir, file, _) = there();
        for text in ["first", "second"] {
            std::fs::write(&file, text).unwrap();
            let said = put_aside(&[(file.clone(), "it is cut short".into())]).unwrap();
            assert!(said[0].contains("a.png is damaged (it is cut short)"), "{said:?}");
        }
        let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
        assert_eq!([read("a.png.damaged"), read("a.png.damaged-1")], ["first", "second"]);
        assert!(!file.exists());
    }

    #[test]
    fn a_flipped_bit_in_a_picture_is_seen_without_decoding_it_and_by_the_check_of_a_whole_run() {
        let dir = tempfile::tempdir().unwrap();
        let run = RunFolder::create(dir.path()).unwrap();
        assert_eq!(run.verify_pictures().unwrap().0, 0);
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
        let (count, damaged) = run.verify_pictures().unwrap();
        assert_eq!((count, damaged.len(), &damaged[0].0), (2, 1, &b));
    }
}
