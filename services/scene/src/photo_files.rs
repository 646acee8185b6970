//! Where photos lie, and which file each of them gets.

use crate::colmap;
use crate::decode::converted;
use crate::names::{ListingEntry, below, is_inside, key, stem, tidy};
use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};

/// Folders, relative to the scene's, in which photos are searched.
pub(crate) const PHOTO_FOLDERS: [&str; 8] =
    ["images", "dense/images", "dense/0/images", "input", "images_2", "images_4", "images_8", "."];

/// The folders of a scene in which photos may lie, the likeliest first, be they there or not.
pub(crate) fn photo_folders(scene: &Path) -> Vec<PathBuf> {
    let folders = PHOTO_FOLDERS.iter().flat_map(|dir| match *dir {
        "dense/0/images" => colmap::numbered_photos(scene),
        "." => vec![scene.join(".")],
        dir => vec![below(scene, dir)],
    });
    folders.collect()
}

/// Why a photo has no file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum LocateError {
    #[error("there is no file of that name in {}", folder.display())]
    NotThere { folder: PathBuf },
    /// `other` is the name of a file that may be the one.
    #[error("there is no file of that name in {}; {other} may be the one: if so, rename it", folder.display())]
    Misnamed { folder: PathBuf, other: String },
    /// Its name leads out of the photo folder, and what is left of it names no file either.
    #[error(
        "its name is not that of a file inside the photo folder, and there is no file of its last part in {}",
        folder.display()
    )]
    OutsideName { folder: PathBuf },
    /// Its file lies elsewhere than in the scene's folder.
    #[error(
        "its file {listed} lies outside of the scene's folder {}: copy it there, or name the folder of the photos with `images`",
        folder.display()
    )]
    OutsideFile { listed: String, folder: PathBuf },
    /// The file is that of the photo `owner`.
    #[error("what is left of its name is {left}, and that is photo {owner} already")]
    Taken { left: String, owner: String },
    /// The file may be that of several photos: some of their names, and how many there are beside them.
    #[error(
        "`{left}` may be that of {}, and is used for none of them",
        either(claimants, *more)
    )]
    Contested { left: String, claimants: Vec<String>, more: usize },
}

/// Names in words: `a or b`, or `a or b or c or 5 others`.
fn either(names: &[String], more: usize) -> String {
    let mut names = names.to_vec();
    names.extend((more > 0).then(|| format!("{more} others")));
    names.join(" or ")
}

/// The file of a photo, or why it has none.
pub(crate) type Claimed = Result<Claim, LocateError>;

/// The file that may be that of a photo.
#[derive(Debug)]
pub(crate) struct Claim {
    pub path: PathBuf,
    /// Its name in the photo folder, where it was found by what is left of the photo's name; `None` where it lies where the photo's
    /// own name says.
    pub left: Option<String>,
}

impl Claim {
    pub(crate) fn left(entry: &ListingEntry) -> Claim {
        Claim { path: entry.path.clone(), left: Some(entry.name.clone()) }
    }
}

/// Gives each file to one photo: the one whose own name it has, else the only one of whose name it is what is left. Where it may be
/// that of several it is that of none, for a pose with another's photo spoils the scene. `names` are those of the photos.
pub(crate) fn settle(names: &[&str], claims: Vec<Claimed>) -> Vec<Claimed> {
    let mut owners: HashMap<PathBuf, &str> = HashMap::new();
    let mut claimants: HashMap<PathBuf, BTreeSet<&str>> = HashMap::new();
    for (name, claim) in names.iter().zip(&claims) {
        match claim {
            Ok(Claim { path, left: None }) => {
                owners.extend(converted(path).map(|copy| (copy, *name)));
                owners.insert(path.clone(), name);
            }
            Ok(Claim { path, left: Some(_) }) => {
                claimants.entry(path.clone()).or_default().insert(name);
            }
            Err(_) => {}
        }
    }
    let settled = |(name, claim): (&&str, Claimed)| {
        let claim = claim?;
        let Some(left) = &claim.left else { return Ok(claim) };
        if let Some(owner) = owners.get(&claim.path) {
            return Err(LocateError::Taken { left: left.clone(), owner: (*owner).to_owned() });
        }
        match claimants.get(&claim.path).and_then(|claimants| contested(left, name, claimants)) {
            None => Ok(claim),
            Some(reason) => Err(reason),
        }
    };
    names.iter().zip(claims).map(settled).collect()
}

/// Why the file `left` is not that of the photo `name`, if it may be that of others of these photos.
fn contested(left: &str, name: &str, claimants: &BTreeSet<&str>) -> Option<LocateError> {
    let file = key(left);
    // Blender's names have no ending.
    let whole = |name: &str| key(name) == file || key(name) == stem(&file);
    let mut others = claimants.iter().filter(|other| tidy(other) != tidy(name));
    others.next()?;
    let mut exact = claimants.iter().filter(|name| whole(name));
    match (exact.next(), exact.next()) {
        (Some(_), None) if whole(name) => None,
        (Some(owner), None) => Some(LocateError::Taken { left: left.to_owned(), owner: (*owner).to_owned() }),
        _ => {
            let more = claimants.len().saturating_sub(SHOWN);
            let claimants = claimants.iter().take(SHOWN).map(|&name| name.to_owned()).collect();
            Some(LocateError::Contested { left: left.to_owned(), claimants, more })
        }
    }
}

/// So many photos that claim one file are named.
const SHOWN: usize = 3;

/// Why a photo has no file, with the file that may be the one.
pub(crate) fn no_file(folder: &Path, name: &str, candidate: Option<&ListingEntry>) -> LocateError {
    let folder = folder.to_owned();
    match candidate {
        Some(entry) => LocateError::Misnamed { folder, other: entry.name.clone() },
        None if !is_inside(name) => LocateError::OutsideName { folder },
        None => LocateError::NotThere { folder },
    }
}
