//! Finds the COLMAP models of a scene, and chooses one of several.

use super::has;
use crate::names::below;
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// Folders within a scene's that hold `sparse`, or a model itself: COLMAP's own, those of its undistorter, of INRIA's and
/// nerfstudio's scripts and of hloc, the nearest first. COLMAP's automatic reconstructor numbers those within `dense`.
const BASES: [&str; 8] = ["", "dense", "dense/0", "colmap", "undistorted", "distorted", "sfm", "outputs/sfm"];
/// The one that stands for all numbers.
const NUMBERED: &str = "dense/0";
/// So many of them are COLMAP's own.
const OWN: usize = 3;
/// Folders of a scene that are searched for a reconstruction, as messages list them: [`BASES`] in words.
pub const MODEL_FOLDERS: [&str; 10] = [
    "sparse/0 (1, 2, ...)",
    "sparse",
    "dense/sparse",
    "dense/0/sparse (1, 2, ...)",
    "colmap/sparse",
    "undistorted/sparse",
    "distorted/sparse",
    "sfm",
    "outputs/sfm",
    "the folder itself",
];

/// The model that is taken, and notes about the others.
pub(crate) struct FoundModel {
    pub dir: PathBuf,
    /// Whether it lies where COLMAP itself puts it: a cameras file beside it is then another program's copy of it. A model elsewhere
    /// is rather what that file was made from.
    pub near: bool,
    pub note: Option<String>,
}

/// A model, and the number of photos that its header claims.
struct ModelCandidate {
    dir: PathBuf,
    photos: u64,
}

/// The model of a scene: the largest in the nearest folder that holds any. A folder farther off is taken only where its largest
/// model is more than twice as large.
pub(crate) fn find(scene: &Path) -> Option<FoundModel> {
    let models_of = |base: &&str| folders(scene, base).iter().flat_map(|base| models(base)).collect();
    let bases: Vec<Vec<ModelCandidate>> = BASES.iter().map(models_of).collect();
    let largest = |models: &[ModelCandidate]| models.iter().map(|m| m.photos).max().unwrap_or(0);
    let most = bases.iter().map(|models| largest(models)).max()?;
    let near = bases.iter().position(|models| !models.is_empty() && 2 * largest(models) >= most)?;
    // Of equals the first.
    let wanted = largest(&bases[near]);
    let chosen = bases[near].iter().find(|m| m.photos == wanted)?;
    let mut others: Vec<String> = bases
        .iter()
        .flatten()
        .filter(|m| m.dir != chosen.dir)
        .map(|m| format!("{} ({})", m.dir.display(), m.photos))
        .collect();
    let mut known = HashSet::new();
    others.retain(|other| known.insert(other.clone()));
    let note = (!others.is_empty()).then(|| {
        format!(
            "there are several models: {} with {wanted} photos is taken, and not {}; to take another, name its folder and that of \
             the photos with `images`",
            chosen.dir.display(),
            others.join(", ")
        )
    });
    Some(FoundModel { dir: chosen.dir.clone(), near: near < OWN, note })
}

/// The folders that a base stands for.
fn folders(scene: &Path, base: &str) -> Vec<PathBuf> {
    match base {
        NUMBERED => numbered(&below(scene, "dense")),
        _ => vec![below(scene, base)],
    }
}

/// The models of one base, `sparse/0` and the like first, then `sparse`, then the base itself.
fn models(base: &Path) -> Vec<ModelCandidate> {
    let sparse = below(base, "sparse");
    let mut dirs = numbered(&sparse);
    dirs.push(sparse);
    // The base may be a folder of models itself, as COLMAP's mapper writes it.
    dirs.extend(numbered(base));
    dirs.push(base.to_owned());
    dirs.into_iter().filter_map(|dir| photos(&dir).map(|photos| ModelCandidate { dir, photos })).collect()
}

/// The photo folders of COLMAP's automatic reconstructor, which numbers its models.
pub(crate) fn numbered_photos(scene: &Path) -> Vec<PathBuf> {
    folders(scene, NUMBERED).iter().map(|base| below(base, "images")).collect()
}

/// Folders whose names are numbers, in order.
fn numbered(dir: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let mut found: Vec<(u64, PathBuf)> = entries
        .filter_map(|entry| Some((entry.file_name().to_str()?.parse().ok()?, entry.path())))
        .filter(|(_, path)| path.is_dir())
        .collect();
    found.sort();
    found.into_iter().map(|(_, path)| path).collect()
}

/// How many photos the model in a folder says it holds; `None` where there is no model. Only of use to compare: the files are read
/// with care later.
fn photos(dir: &Path) -> Option<u64> {
    use std::io::Read;
    if has(dir, "bin") {
        let mut count = [0; 8];
        let read = crate::decode::open_file(&dir.join("images.bin"))
            .and_then(|mut file| file.read_exact(&mut count));
        // No file of that length holds so many: a damaged count must not win.
        let most = std::fs::metadata(dir.join("images.bin")).map_or(0, |m| m.len() / 72);
        return Some(if read.is_ok() { u64::from_le_bytes(count).min(most) } else { 0 });
    }
    if !has(dir, "txt") {
        return None;
    }
    let text = crate::bytes::read_bytes(&dir.join("images.txt")).unwrap_or_default();
    let lines = text
        .split(|&b| b == b'\n')
        .filter(|line| !line.starts_with(b"#") && !line.starts_with(b"\xef\xbb\xbf#"));
    // Two lines each.
    Some(lines.count() as u64 / 2)
}
