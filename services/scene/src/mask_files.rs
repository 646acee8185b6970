//! Which file is the mask of a photo.

use crate::endings::READ;
use crate::names::{Listing, ListingEntry, key, last_part, stem};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Why it is open which file is the mask of a photo.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MaskFileError {
    /// A file may be the mask of the photo or of another one, whose name differs in its ending alone.
    #[error(
        "{file} may be its mask or that of a photo which differs in its ending alone: name it {photo}.png",
        file = file.display()
    )]
    Shared {
        /// The file.
        file: PathBuf,
        /// The last part of the photo's name.
        photo: String,
    },
    /// Two files may be its mask.
    #[error(
        "{one} and {two} may both be the mask of {photo}: keep one of them",
        one = one.display(),
        two = two.display()
    )]
    Two {
        /// The first of them.
        one: PathBuf,
        /// The second.
        two: PathBuf,
        /// Name of the photo.
        photo: String,
    },
}

/// The masks in a folder, found by the names of photos. The naming of mask files is defined here and nowhere else.
///
/// The mask of photo `a/b.jpg` is `a/b.jpg.png` (as COLMAP names it) or `a/b.png`; failing those, the same with another ending
/// of images; failing those, the same without the folder (`b.png`) or with the folder in the name (`a_b.png`), where no other
/// photo could mean that file. Where photos differ in their endings alone (`b.jpg` and `b.png`), `b.png` could be the mask of either, and
/// only `b.jpg.png` counts. Upper and lower case count only where two files differ in nothing else.
#[derive(Debug)]
pub struct MaskFiles {
    listing: Listing,
    /// How many photos have the same last part, or the same name once their folders are part of it, endings aside.
    short: HashMap<String, usize>,
    /// Whole names without their endings that more than one photo has.
    shared: HashSet<String>,
}

impl MaskFiles {
    /// Lists the masks in `folder` for photos of these names, all those of the scene.
    pub fn new<'a>(folder: &Path, photos: impl IntoIterator<Item = &'a str>) -> MaskFiles {
        let mut short: HashMap<String, usize> = HashMap::new();
        let (mut whole, mut shared) = (HashMap::new(), HashSet::new());
        for photo in photos {
            let key = key(photo);
            let first = whole.entry(stem(&key).to_owned()).or_insert_with(|| key.clone());
            if *first != key {
                shared.insert(stem(&key).to_owned());
            }
            for name in without_folder(&key) {
                *short.entry(stem(&name).to_owned()).or_default() += 1;
            }
        }
        MaskFiles { listing: Listing::of(folder), short, shared }
    }

    /// The mask of a photo; `None` where it has none.
    ///
    /// # Errors
    /// Two files may be its mask, or one may be that of another photo as well.
    pub fn find(&self, photo: &str) -> Result<Option<PathBuf>, MaskFileError> {
        let (usual, others) = READ.split_at(1);
        let key = key(photo);
        let only = |name: &String| self.short.get(stem(name)).is_none_or(|&n| n <= 1);
        let short: Vec<String> = without_folder(&key).into_iter().filter(only).collect();
        let whole = vec![crate::names::tidy(photo)];
        for (names, endings) in [(&whole, usual), (&whole, others), (&short, usual), (&short, others)] {
            if let Some(found) = self.one_of(photo, names, endings)? {
                return Ok(Some(found.path.clone()));
            }
        }
        self.not_shared(photo).map(|()| None)
    }

    /// Refuses a photo whose mask may be a file that may be another's too: without the mask, the photo would show what is to be
    /// left out.
    fn not_shared(&self, photo: &str) -> Result<(), MaskFileError> {
        let key = key(photo);
        let stem = stem(&key);
        if !self.shared.contains(stem) {
            return Ok(());
        }
        let files = READ.iter().flat_map(|ending| self.listing.named(&format!("{stem}.{ending}")));
        match files.into_iter().next() {
            None => Ok(()),
            Some(file) => {
                Err(MaskFileError::Shared { file: file.path.clone(), photo: last_part(photo).to_owned() })
            }
        }
    }

    fn one_of(
        &self,
        photo: &str,
        names: &[String],
        endings: &[&str],
    ) -> Result<Option<&ListingEntry>, MaskFileError> {
        let mut found: Vec<&ListingEntry> = Vec::new();
        let shared = self.shared.contains(stem(&key(photo)));
        for name in names {
            for ending in endings {
                found.extend(self.listing.named(&format!("{name}.{ending}")));
                if !shared {
                    found.extend(self.listing.named(&format!("{}.{ending}", stem(name))));
                }
            }
        }
        found.dedup();
        match found[..] {
            [] => Ok(None),
            [one] => Ok(Some(one)),
            [one, two, ..] => Err(MaskFileError::Two {
                one: one.path.clone(),
                two: two.path.clone(),
                photo: photo.to_owned(),
            }),
        }
    }

    /// Names that the mask of a photo may have, for a message.
    pub fn wanted(photo: &str) -> String {
        format!("{}.png or {}.png", stem(photo), last_part(photo))
    }

    /// Whether the folder holds no file at all.
    pub fn is_empty(&self) -> bool {
        self.listing.is_empty()
    }
}

/// The short forms of a name with folders: its last part, and its folders as part of the name.
fn without_folder(key: &str) -> Vec<String> {
    if !key.contains('/') {
        return vec![key.to_owned()];
    }
    vec![last_part(key).to_owned(), key.replace('/', "_")]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_that_differ_in_their_endings_alone_do_not_share_a_mask() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["a.png", "b.png", "c.png", "c.jpg.png"] {
            std::fs::write(dir.path().join(name), b"").unwrap();
        }
        let masks = MaskFiles::new(dir.path(), ["a.jpg", "a.png", "b.jpg", "b.jpg", "c.jpg", "c.png"]);
        let a = ["a.jpg", "a.png"].map(|photo| masks.find(photo).unwrap_err().to_string());
        assert!(a[0].contains("name it a.jpg.png") && a[1].contains("name it a.png.png"), "{a:?}");
        // One photo listed twice is one photo.
        assert_eq!(masks.find("b.jpg"), Ok(Some(dir.path().join("b.png"))));
        assert_eq!(masks.find("c.jpg"), Ok(Some(dir.path().join("c.jpg.png"))));
        assert!(masks.find("c.png").is_err());
    }

    #[test]
    fn masks_are_found_by_every_programs_name_for_them() {
        let dir = tempfile::tempdir().unwrap();
        let photos = [
            "a.jpg", "b.jpg", "c.jpg", "D.JPG", "in/e.jpg", "x/f.jpg", "y/f.jpg", "in/g.jpg", "h.jpg",
            "i.jpg",
        ];
        let files = [
            "a.jpg.png",
            "b.png",
            "c.PNG",
            "d.tif",
            "in/e.bmp",
            "f.png",
            "x_f.png",
            "g.webp",
            "h.png",
            "h.jpg.png",
            "i.jpg",
            "i.png",
        ];
        for name in files {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"").unwrap();
        }
        let masks = MaskFiles::new(dir.path(), photos);
        let found = |photo: &str| {
            let found = masks.find(photo).unwrap();
            found.map(|p| p.strip_prefix(dir.path()).unwrap().to_string_lossy().into_owned())
        };
        let wanted = [
            ("a.jpg", Some("a.jpg.png")),
            ("b.jpg", Some("b.png")),
            ("c.jpg", Some("c.PNG")),
            ("D.JPG", Some("d.tif")),
            ("in/e.jpg", Some("in/e.bmp")),
            // `f.png` may be that of either; the other name says which.
            ("x/f.jpg", Some("x_f.png")),
            ("y/f.jpg", None),
            ("in/g.jpg", Some("g.webp")),
            // What a program writes as PNG is rather a mask than what has the photo's own name.
            ("i.jpg", Some("i.png")),
        ];
        for (photo, file) in wanted {
            assert_eq!(found(photo).as_deref(), file, "{photo}");
        }
        let both = masks.find("h.jpg").unwrap_err().to_string();
        assert!(both.contains("h.png") && both.contains("h.jpg.png"), "{both}");
    }
}
