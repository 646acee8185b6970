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

/// The file of a photo, or in words why it has none.
pub(crate) type Claimed = Result<Claim, String>;

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
    let settled = |(name, claim): (&&str, Result<Claim, String>)| {
        let claim = claim?;
        let Some(left) = &claim.left else { return Ok(claim) };
        if let Some(owner) = owners.get(&claim.path) {
            return Err(format!("what is left of its name is {left}, and that is photo {owner} already"));
        }
        match claimants.get(&claim.path).and_then(|claimants| contested(left, name, claimants)) {
            None => Ok(claim),
            Some(reason) => Err(reason),
        }
    };
    names.iter().zip(claims).map(settled).collect()
}

/// Why the file `left` is not that of the photo `name`, if it may be that of others of these photos.
fn contested(left: &str, name: &str, claimants: &BTreeSet<&str>) -> Option<String> {
    let file = key(left);
    // Blender's names have no ending.
    let whole = |name: &str| key(name) == file || key(name) == stem(&file);
    let mut others = claimants.iter().filter(|other| tidy(other) != tidy(name));
    others.next()?;
    let mut exact = claimants.iter().filter(|name| whole(name));
    match (exact.next(), exact.next()) {
        (Some(_), None) if whole(name) => None,
        (Some(owner), None) => {
            Some(format!("what is left of its name is {left}, and that is photo {owner} already"))
        }
        _ => {
            let mut some: Vec<&str> = claimants.iter().take(SHOWN).copied().collect();
            let more = format!("{} others", claimants.len() - some.len());
            some.extend((claimants.len() > SHOWN).then_some(more.as_str()));
            Some(format!("`{left}` may be that of {}, and is used for none of them", some.join(" or ")))
        }
    }
}

/// So many photos that claim one file are named.
const SHOWN: usize = 3;

/// Why a photo has no file, with the file that may be the one.
pub(crate) fn no_file(folder: &Path, name: &str, candidate: Option<&ListingEntry>) -> String {
    let dir = folder.display();
    match candidate {
        Some(entry) => {
            format!("there is no file of that name in {dir}; {} may be the one: if so, rename it", entry.name)
        }
        None if !is_inside(name) => {
            format!(
                "its name is not that of a file inside the photo folder, and there is no file of its last part in {dir}"
            )
        }
        None => format!("there is no file of that name in {dir}"),
    }
}
