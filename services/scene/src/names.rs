//! Files of a folder found by the names that other programs and systems give them.

use crate::text;
use std::collections::HashMap;
use std::path::{Component, Path, PathBuf};
use unicode_normalization::UnicodeNormalization;

/// Folders deeper than this below the photo folder are not looked into.
const DEPTH: usize = 12;

/// A name with `/` between its folders, whatever the system that wrote it, and without `./`.
pub(crate) fn tidy(name: &str) -> String {
    let parts = name.split(['/', '\\']).filter(|part| !part.is_empty() && *part != ".");
    parts.collect::<Vec<_>>().join("/")
}

/// Normal form of a name, equal for names that a person takes for the same: case and the kind of slash do not count, nor whether
/// an accent is a character of its own, as Macs write it, or part of its letter.
pub(crate) fn key(name: &str) -> String {
    tidy(name).to_lowercase().nfc().collect()
}

/// A file or folder below a folder, found where its name is written in other capitals or accents; as it is written where there is
/// none, or several.
pub(crate) fn below(folder: &Path, name: &str) -> PathBuf {
    tidy(name).split('/').filter(|part| !part.is_empty()).fold(folder.to_owned(), |folder, part| {
        let exact = folder.join(part);
        if exact.exists() { exact } else { alike(&folder, part).unwrap_or(exact) }
    })
}

/// The only entry of a folder whose name is the same to a person.
fn alike(folder: &Path, name: &str) -> Option<PathBuf> {
    let wanted = key(name);
    let entries = std::fs::read_dir(folder).ok()?.flatten();
    let mut found = entries.filter(|entry| key(&entry.file_name().to_string_lossy()) == wanted);
    let one = found.next()?;
    found.next().is_none().then(|| one.path())
}

/// The part of a name after its folders.
pub(crate) fn last_part(name: &str) -> &str {
    name.rsplit(['/', '\\']).next().unwrap_or(name)
}

/// A name without its ending.
pub(crate) fn stem(name: &str) -> &str {
    let folders = name.len() - last_part(name).len();
    match name[folders..].rfind('.') {
        Some(dot) if dot > 0 => &name[..folders + dot],
        _ => name,
    }
}

/// Whether a name stays inside the folder it is relative to: names become the names of files that are written.
pub(crate) fn is_inside(name: &str) -> bool {
    let normal = |c: Component<'_>| matches!(c, Component::Normal(_));
    !name.is_empty() && !name.contains('\0') && Path::new(name).components().all(normal)
}

/// A file below a folder.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ListingEntry {
    /// Its name relative to the folder, with `/`; bytes that are not UTF-8 are taken as Latin-1.
    pub name: String,
    pub path: PathBuf,
}

/// All files below a folder, by name.
#[derive(Debug, Default)]
pub(crate) struct Listing {
    entries: Vec<ListingEntry>,
    by_key: HashMap<String, Vec<usize>>,
    /// By the key of the last part, and by that without its ending.
    by_last: HashMap<String, Vec<usize>>,
    by_stem: HashMap<String, Vec<usize>>,
}

impl Listing {
    /// Lists the files below a folder, in order; a folder that cannot be read is empty. Links to folders are not followed.
    pub fn of(folder: &Path) -> Listing {
        let mut listing = Listing::default();
        walk(folder, "", DEPTH, &mut listing.entries);
        listing.entries.sort_by(|a, b| a.name.cmp(&b.name));
        for (i, entry) in listing.entries.iter().enumerate() {
            let key = key(&entry.name);
            listing.by_stem.entry(stem(last_part(&key)).to_owned()).or_default().push(i);
            listing.by_last.entry(last_part(&key).to_owned()).or_default().push(i);
            listing.by_key.entry(key).or_default().push(i);
        }
        listing
    }

    /// The files of a name, where case does not count; the one of exactly this name alone, if there is one.
    pub fn named(&self, name: &str) -> Vec<&ListingEntry> {
        let tidied = tidy(name);
        let found = self.by_key.get(&key(&tidied)).map_or(&[][..], Vec::as_slice);
        let found: Vec<&ListingEntry> = found.iter().map(|&i| &self.entries[i]).collect();
        match found.iter().find(|e| e.name == tidied) {
            Some(exact) => vec![exact],
            None => found,
        }
    }

    /// The file whose whole name is the longest end of `name`: what is left of a name from another machine. Where case alone
    /// distinguishes two files and neither is written as `name` is, it is none.
    pub fn tail(&self, name: &str) -> Option<&ListingEntry> {
        let tidied = tidy(name);
        let starts = std::iter::once(0).chain(tidied.match_indices('/').map(|(at, _)| at + 1));
        for start in starts {
            match self.named(&tidied[start..])[..] {
                [] => {}
                [one] => return Some(one),
                _ => return None,
            }
        }
        None
    }

    /// A file that may be the one that a person means by a name which is not there: the same last part, or the same but for the
    /// ending.
    pub fn candidate(&self, name: &str) -> Option<&ListingEntry> {
        let key = key(name);
        let last = last_part(&key);
        let found = self.by_last.get(last).or_else(|| self.by_stem.get(stem(last)))?;
        found.first().map(|&i| &self.entries[i])
    }

    /// All files, by name.
    pub fn into_entries(self) -> Vec<ListingEntry> {
        self.entries
    }

    /// Whether there is no file.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }
}

fn walk(folder: &Path, within: &str, depth: usize, found: &mut Vec<ListingEntry>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        let name = format!("{within}{}", text::line(entry.file_name().as_encoded_bytes()));
        let Ok(kind) = entry.file_type() else { continue };
        if kind.is_dir() {
            if depth > 0 {
                walk(&path, &format!("{name}/"), depth - 1, found);
            }
        } else if kind.is_file() || path.is_file() {
            found.push(ListingEntry { name, path });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_found_by_what_is_left_of_its_name() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["a.JPG", "cam0/a.jpg", "cam1/b.jpg", "cam1/B.jpg", "c.png"] {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"").unwrap();
        }
        let listing = Listing::of(dir.path());
        let tail = |name: &str| listing.tail(name).map(|e| e.name.as_str());
        assert_eq!(tail(r"C:\Users\x\cam0\a.jpg"), Some("cam0/a.jpg"));
        assert_eq!(tail("/home/other/images/a.jpg"), Some("a.JPG"));
        assert_eq!(tail("../../a.jpg"), Some("a.JPG"));
        assert_eq!((tail("cam1/b.jpg"), tail("x/cam1/B.jpg")), (Some("cam1/b.jpg"), Some("cam1/B.jpg")));
        // They differ in case alone; and a file in another folder is not the same.
        assert_eq!((tail("CAM1/B.JPG"), tail("cam2/b.jpg")), (None, None));
        let candidate = |name: &str| listing.candidate(name).map(|e| e.name.as_str());
        assert_eq!((candidate("cam2/b.jpg"), candidate("c.jpg")), (Some("cam1/B.jpg"), Some("c.png")));
        assert_eq!(candidate("nothing.jpg"), None);
    }

    #[test]
    fn names_with_accents_are_the_same_whichever_system_wrote_them() {
        let (composed, decomposed) = ("\u{c9}glise/caf\u{e9}.jpg", "E\u{301}glise/cafe\u{301}.jpg");
        assert_eq!(key(composed), key(decomposed));
        assert_ne!(key("cafe.jpg"), key("caf\u{e9}.jpg"));
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("E\u{301}glise")).unwrap();
        std::fs::write(dir.path().join(decomposed), b"").unwrap();
        let listing = Listing::of(dir.path());
        assert_eq!(listing.tail(composed).map(|e| e.name.as_str()), Some(decomposed));
        assert_eq!(below(dir.path(), composed), dir.path().join(decomposed));
    }

    #[test]
    fn folders_in_other_capitals_are_found_where_it_is_clear_which_is_meant() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for name in ["Sparse/0", "images", "Images", "MASKS", "Masks"] {
            std::fs::create_dir_all(at(name)).unwrap();
        }
        assert_eq!(below(dir.path(), "sparse/0"), at("Sparse/0"));
        assert_eq!(below(dir.path(), "images"), at("images"));
        assert_eq!(below(dir.path(), "masks"), at("masks"), "it may be either");
        assert_eq!(below(dir.path(), "dense/0"), at("dense/0"));
    }

    #[test]
    fn names_are_taken_apart_whatever_the_slash() {
        assert_eq!(
            (last_part(r"a\b.c"), stem("a.b/c"), stem("a/b.c.jpg"), stem(".x")),
            ("b.c", "a.b/c", "a/b.c", ".x")
        );
        assert_eq!(key(r".\Images//A.jpg"), "images/a.jpg");
        assert!(is_inside("a/b") && !is_inside("../b") && !is_inside("/b") && !is_inside(""));
    }
}
