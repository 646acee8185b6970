//! Which photos are for training and which for testing: the conventions of several data sets, with one meaning.
//!
//! - NeRF-W's tables for Photo Tourism (`*.tsv`: filename, id, split, dataset).
//! - `split.json` of NeRF On-the-go (`clutter` trains, `extra` tests; names, or numbers into the sorted names of transforms.json),
//!   and others with `train`, `test` and `val`.
//! - `train_list.txt` and `test_list.txt` of WildGaussians, `train.txt` and `test.txt` of INRIA: a name a line.
//! - `train_filenames`, `val_filenames` and `test_filenames` inside nerfstudio's transforms.json.
//! - Blender's `transforms_train.json`, `transforms_val.json` and `transforms_test.json`.
//! - RobustNeRF's names: `clutter` trains, `extra` tests.

use crate::names::{below, key, last_part, stem};
use crate::transforms_json::frame_names;
use crate::{SceneError, SceneSettings, text};
use serde_json::Value;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

/// The part of the split that a photo belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum SplitPart {
    Train,
    /// For choosing settings, where there is a test part too: it takes no part here.
    Validation,
    /// Held out.
    Test,
    /// A row without an id: the reconstruction has no pose of the photo.
    NoPose,
}

/// A split, whatever it was read from.
#[derive(Clone, Debug)]
pub(crate) struct Split {
    /// What it was read from.
    pub(crate) path: PathBuf,
    pub(crate) rows: Vec<(String, SplitPart)>,
    /// Whether photos that it does not list take no part; otherwise they are for training.
    closed: bool,
    by_key: HashMap<String, usize>,
    /// By the last part without its ending, and by the last part where that is another.
    by_last: HashMap<String, Vec<usize>>,
    /// The rows of the scene's photos, by the keys of their names.
    known: HashMap<String, Option<usize>>,
}

/// The names of files with a name a line.
const LISTS: [(&str, SplitPart); 5] = [
    ("train_list.txt", SplitPart::Train),
    ("test_list.txt", SplitPart::Test),
    ("val_list.txt", SplitPart::Validation),
    ("train.txt", SplitPart::Train),
    ("test.txt", SplitPart::Test),
];

/// Keys of JSON files, and the part that their photos belong to.
const KEYS: [(&str, SplitPart); 12] = [
    ("clutter", SplitPart::Train),
    ("train", SplitPart::Train),
    ("train_filenames", SplitPart::Train),
    ("extra", SplitPart::Test),
    ("test", SplitPart::Test),
    ("test_filenames", SplitPart::Test),
    ("val", SplitPart::Validation),
    ("validation", SplitPart::Validation),
    ("val_filenames", SplitPart::Validation),
    ("eval", SplitPart::Validation),
    ("clean", SplitPart::Validation),
    ("clear", SplitPart::Validation),
];

impl Split {
    /// A split of these rows. Of several rows of one photo, testing counts before validation and that before training. Where
    /// nothing is for testing, what is for validation is.
    pub(crate) fn new(
        path: &Path,
        rows: impl IntoIterator<Item = (String, SplitPart)>,
        closed: bool,
    ) -> Split {
        let mut parts: BTreeMap<String, SplitPart> = BTreeMap::new();
        for (name, part) in rows {
            let known = parts.entry(name).or_insert(part);
            *known = part.max(*known);
        }
        let mut rows: Vec<(String, SplitPart)> = parts.into_iter().collect();
        if rows.iter().all(|(_, part)| *part != SplitPart::Test) {
            let held = rows.iter_mut().filter(|(_, part)| *part == SplitPart::Validation);
            held.for_each(|(_, part)| *part = SplitPart::Test);
        }
        let mut by_key = HashMap::new();
        let mut by_last: HashMap<String, Vec<usize>> = HashMap::new();
        for (i, (name, _)) in rows.iter().enumerate() {
            let key = key(name);
            let last = last_part(&key).to_owned();
            if stem(&last) != last {
                by_last.entry(stem(&last).to_owned()).or_default().push(i);
            }
            by_last.entry(last).or_default().push(i);
            by_key.entry(key).or_insert(i);
        }
        Split { path: path.to_owned(), rows, closed, by_key, by_last, known: HashMap::new() }
    }

    /// Reads the file that a person named.
    pub(crate) fn read(path: &Path, photos: &[&str]) -> Result<Split, SceneError> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        match ending.as_str() {
            "json" => read_json(path, photos),
            "txt" => {
                let train =
                    path.file_name().is_some_and(|n| n.to_string_lossy().to_lowercase().starts_with("train"));
                let part = if train { SplitPart::Train } else { SplitPart::Test };
                let mut lists = vec![(path.to_owned(), part)];
                // Its partner, which says the rest.
                let partners = LISTS.iter().filter(|(_, other)| *other != part);
                let folder = path.parent().unwrap_or(Path::new(""));
                let beside = |(name, part): &(&str, SplitPart)| (below(folder, name), *part);
                lists.extend(partners.map(beside).filter(|(path, _)| path.is_file()));
                read_lists(&lists)
            }
            _ => read_table(path),
        }
    }

    /// Finds the split of a scene, if it has one, and adds notes about other splits. `near` are the folders it may lie in, `photos`
    /// the names in the reconstruction, `own` the split of the reconstruction itself.
    pub(crate) fn find(
        near: &[&Path],
        settings: &SceneSettings,
        photos: &[&str],
        own: Option<Split>,
        notes: &mut Vec<String>,
    ) -> Result<Option<Split>, SceneError> {
        let found = Split::choose(near, settings, photos, own, notes)?;
        Ok(found.map(|split| split.of(photos)))
    }

    fn choose(
        near: &[&Path],
        settings: &SceneSettings,
        photos: &[&str],
        own: Option<Split>,
        notes: &mut Vec<String>,
    ) -> Result<Option<Split>, SceneError> {
        if settings.split == "none" {
            return Ok(None);
        }
        let folder = near[0];
        if !settings.split.is_empty() {
            let paths = [PathBuf::from(&settings.split), folder.join(&settings.split)];
            let found = paths.into_iter().find(|p| p.is_file()).ok_or_else(|| SceneError::Setting {
                setting: "split",
                value: settings.split.clone(),
                reason: "there is no such file".into(),
            })?;
            return Split::read(&found, photos).map(Some);
        }
        let mut found: Vec<Split> = Vec::new();
        let names_some = |split: &Split| photos.iter().any(|photo| split.row(photo).is_some());
        for path in tables(folder)? {
            let text = text::read(&path)?;
            if let Err(reason) = columns(&heads(text.lines().find(|line| !line.trim().is_empty()))) {
                notes.push(passed_over(&path, &reason.to_string()));
                continue;
            }
            let split = table_of(&path, &text)?;
            if names_some(&split) {
                found.push(split);
            } else {
                notes.push(passed_over(&path, "it names no photo of this scene"));
            }
        }
        let json = below(folder, "split.json");
        if json.is_file() {
            found.push(read_json(&json, photos)?);
        }
        for dir in near {
            let lists = LISTS.iter().map(|(name, part)| (below(dir, name), *part));
            let lists: Vec<_> = lists.filter(|(path, _)| path.is_file()).collect();
            if lists.is_empty() {
                continue;
            }
            let split = read_lists(&lists)?;
            if names_some(&split) {
                found.push(split);
            } else {
                notes.push(format!(
                    "{}: it names no photo of this scene and is no split of it",
                    split.path.display()
                ));
            }
        }
        if let [one, two, ..] = &found[..] {
            return Err(SceneError::Setting {
                setting: "split",
                value: "nothing".into(),
                reason: format!(
                    "there are several splits, such as {} and {}; name one",
                    one.path.display(),
                    two.path.display()
                ),
            });
        }
        let own = match (own, &found[..]) {
            (None, found) => by_names(photos, folder).unwrap_or_else(|odd| {
                notes.extend(found.is_empty().then(|| odd.to_string()));
                None
            }),
            (own, _) => own,
        };
        match (found.pop(), own) {
            (Some(found), Some(own)) => {
                notes.push(format!(
                    "the split {} is taken, and not what {} says",
                    found.path.display(),
                    own.path.display()
                ));
                Ok(Some(found))
            }
            (found, own) => Ok(found.or(own)),
        }
    }

    /// The part of a photo, known by its whole name or by the last part of it; `None` where the photo is not listed and for that
    /// reason left out.
    pub(crate) fn part(&self, name: &str) -> Option<SplitPart> {
        match self.row(name) {
            Some(row) => Some(self.rows[row].1),
            None => (!self.closed).then_some(SplitPart::Train),
        }
    }

    /// The same for the photos of a scene: a row is that of the photos whose names fit it best, and of no others.
    fn of(mut self, photos: &[&str]) -> Split {
        let keys: BTreeSet<String> = photos.iter().map(|photo| key(photo)).collect();
        let mut best = vec![NameFit::StemTail; self.rows.len()];
        for key in &keys {
            for (row, fit) in self.fitting(key) {
                best[row] = best[row].min(fit);
            }
        }
        let row = |key: String| {
            let row = self.best(&key, |row, fit| fit <= best[row]);
            (key, row)
        };
        self.known = keys.into_iter().map(row).collect();
        self
    }

    /// The row of a photo.
    pub(crate) fn row(&self, name: &str) -> Option<usize> {
        let key = key(name);
        self.known.get(&key).copied().unwrap_or_else(|| self.best(&key, |_, _| true))
    }

    /// The row that fits a photo best: of several the one that has most of the name in common, and of such the first.
    fn best(&self, key: &str, may: impl Fn(usize, NameFit) -> bool) -> Option<usize> {
        let common = |row: usize| self.rows[row].0.len().min(key.len());
        let fitting = self.fitting(key).into_iter().filter(|&(row, fit)| may(row, fit));
        fitting.min_by_key(|&(row, fit)| (fit, Reverse(common(row)), row)).map(|(row, _)| row)
    }

    /// The rows that may be those of a photo.
    fn fitting(&self, photo: &str) -> Vec<(usize, NameFit)> {
        if let Some(&row) = self.by_key.get(photo) {
            return vec![(row, NameFit::Whole)];
        }
        let last = last_part(photo);
        let rows = [last, stem(last)].into_iter().filter_map(|name| self.by_last.get(name)).flatten();
        rows.filter_map(|&row| Some((row, fit(photo, &key(&self.rows[row].0))?))).collect()
    }

    /// The rows that are of none of these photos.
    pub(crate) fn unmatched<'a>(&'a self, photos: &[&str]) -> Vec<&'a (String, SplitPart)> {
        let matched: BTreeSet<usize> = photos.iter().filter_map(|photo| self.row(photo)).collect();
        let rows = self.rows.iter().enumerate().filter(|(i, _)| !matched.contains(i));
        rows.map(|(_, row)| row).collect()
    }
}

/// How the name of a photo fits that in a row, the best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum NameFit {
    Whole,
    /// But for the ending.
    Stem,
    /// One is what is left of the other, from one of its folders on.
    Tail,
    /// But for the ending, too.
    StemTail,
}

/// How two keys fit; `None` where they are names of different photos.
fn fit(photo: &str, row: &str) -> Option<NameFit> {
    let is_end = |of: &str, end: &str| of.strip_suffix(end).is_some_and(|start| start.ends_with('/'));
    let is_tail = |a: &str, b: &str| is_end(a, b) || is_end(b, a);
    // Either may have no ending, and then a dot in it is part of the name.
    let pairs = [(photo, stem(row)), (stem(photo), row), (stem(photo), stem(row))];
    if photo == row {
        Some(NameFit::Whole)
    } else if pairs.iter().any(|(a, b)| a == b) {
        Some(NameFit::Stem)
    } else if is_tail(photo, row) {
        Some(NameFit::Tail)
    } else {
        pairs.iter().any(|(a, b)| is_tail(a, b)).then_some(NameFit::StemTail)
    }
}

/// NeRF-W's tables in a folder.
fn tables(folder: &Path) -> Result<Vec<PathBuf>, SceneError> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(SceneError::io(folder))? {
        let path = entry.map_err(SceneError::io(folder))?.path();
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("tsv")) && path.is_file() {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The note about a table that is not used.
fn passed_over(path: &Path, reason: &str) -> String {
    format!(
        "{}: {reason}; it is no split of this scene and is not used (`--split none` looks for none)",
        path.display()
    )
}

/// The heads of a table's columns.
fn heads(line: Option<&str>) -> Vec<&str> {
    line.map(|line| line.split('\t').map(str::trim).collect()).unwrap_or_default()
}

/// Why a table is no split.
#[derive(Debug, thiserror::Error)]
enum ColumnsError {
    #[error("the file is empty")]
    Empty,
    #[error("there is no column `{0}`; a split has filename, id and split, tab-separated")]
    Missing(&'static str),
}

/// The columns of a split among those of a table: filename, id, split.
fn columns(heads: &[&str]) -> Result<[usize; 3], ColumnsError> {
    if heads.is_empty() {
        return Err(ColumnsError::Empty);
    }
    let column =
        |name: &'static str| heads.iter().position(|head| *head == name).ok_or(ColumnsError::Missing(name));
    Ok([column("filename")?, column("id")?, column("split")?])
}

fn read_table(path: &Path) -> Result<Split, SceneError> {
    table_of(path, &text::read(path)?)
}

/// The split of a table's text.
fn table_of(path: &Path, text: &str) -> Result<Split, SceneError> {
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
    let head = heads(lines.next().map(|(_, head)| head));
    let [name, id, split] = columns(&head).map_err(|e| SceneError::invalid(path, "line 1", e))?;
    let mut rows = BTreeMap::new();
    for (i, line) in lines {
        let cells: Vec<&str> = line.split('\t').map(str::trim).collect();
        let cell = |c: usize| cells.get(c).copied().unwrap_or("");
        let invalid = |reason: String| SceneError::invalid(path, format!("line {}", i + 1), reason);
        if cell(name).is_empty() {
            return Err(invalid("the row names no photo".into()));
        }
        let part = match (cell(id), cell(split)) {
            ("", _) => SplitPart::NoPose,
            (_, "train") => SplitPart::Train,
            (_, "test") => SplitPart::Test,
            (_, other) => return Err(invalid(format!("`{other}` is neither train nor test"))),
        };
        if rows.insert(cell(name).to_owned(), part).is_some() {
            return Err(invalid(format!("photo {} is listed twice", cell(name))));
        }
    }
    Ok(Split::new(path, rows, true))
}

fn read_lists(lists: &[(PathBuf, SplitPart)]) -> Result<Split, SceneError> {
    let mut rows = Vec::new();
    for (path, part) in lists {
        let text = text::read(path)?;
        let names = text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
        rows.extend(names.map(|name| (name.to_owned(), *part)));
    }
    let closed = lists.iter().any(|(_, part)| *part == SplitPart::Train);
    Ok(Split::new(&lists[0].0, rows, closed))
}

fn read_json(path: &Path, photos: &[&str]) -> Result<Split, SceneError> {
    let text = text::read(path)?;
    let invalid = |location: String, reason: String| SceneError::invalid(path, location, reason);
    let value: Value = serde_json::from_str(&text)
        .map_err(|e| invalid(format!("line {} column {}", e.line(), e.column()), e.to_string()))?;
    let known = |(name, part): &(&'static str, SplitPart)| Some((*name, *part, value.get(name)?));
    let lists: Vec<_> = KEYS.iter().filter_map(known).collect();
    if lists.is_empty() {
        let keys = KEYS.map(|(name, _)| name).join(", ");
        return Err(invalid("text".into(), format!("it is no split: it has none of the lists {keys}")));
    }
    let sorted = numbered(path, photos);
    let mut rows = Vec::new();
    for (name, part, list) in &lists {
        let list =
            list.as_array().ok_or_else(|| invalid((*name).into(), "it is no list of photos".into()))?;
        for entry in list {
            let photo = match (entry.as_str(), entry.as_u64()) {
                (Some(photo), _) => photo.to_owned(),
                (None, Some(at)) => sorted.get(at as usize).cloned().ok_or_else(|| {
                    invalid(
                        (*name).into(),
                        format!("there is no photo number {at}: there are {}", sorted.len()),
                    )
                })?,
                (None, None) => {
                    return Err(invalid(
                        (*name).into(),
                        format!("{entry} is neither the name nor the number of a photo"),
                    ));
                }
            };
            rows.push((photo, *part));
        }
    }
    let closed = lists.iter().any(|(_, part, _)| *part == SplitPart::Train);
    Ok(Split::new(path, rows, closed))
}

/// The photos that numbers in a split.json stand for: the names of the frames of the transforms.json beside it, or of the photos of the
/// reconstruction, by their last parts in order. A last part that several have stands for none of them alone: those keep their folders.
fn numbered(split: &Path, photos: &[&str]) -> Vec<String> {
    let beside = frame_names(&split.with_file_name("transforms.json"));
    let names = beside.unwrap_or_else(|| photos.iter().map(|name| (*name).to_owned()).collect());
    let mut names: Vec<(&str, &str)> = names.iter().map(|name| (last_part(name), name.as_str())).collect();
    names.sort_unstable();
    let mut count: HashMap<&str, usize> = HashMap::new();
    names.iter().for_each(|(last, _)| *count.entry(last).or_default() += 1);
    names.iter().map(|(last, whole)| if count[last] > 1 { *whole } else { *last }.to_owned()).collect()
}

/// Photos are named as RobustNeRF names them, but not so that they make a split.
#[derive(Debug, thiserror::Error)]
#[error(
    "the photos are named as RobustNeRF names them ({train} `clutter`, {test} `extra`, {clean} `clean`), but {why}: no split is made \
     of the names, and all photos train; to hold some out, list them in a test_list.txt",
    why = other.as_ref().map_or_else(|| "none is called `extra`".to_owned(), |other| format!("{other} is called neither"))
)]
struct NamesError {
    /// How many photos have each part in their names.
    train: usize,
    test: usize,
    clean: usize,
    /// A photo whose name has none; `None` where all have one, and none is for testing.
    other: Option<String>,
}

/// RobustNeRF's photos carry their part in their names.
///
/// # Errors
/// A note for the user: some photos are named so, but they make no split.
fn by_names(photos: &[&str], folder: &Path) -> Result<Option<Split>, NamesError> {
    let part = |name: &str| {
        let last = last_part(name).to_lowercase();
        let parts =
            [("clutter", SplitPart::Train), ("extra", SplitPart::Test), ("clean", SplitPart::Validation)];
        parts.into_iter().find(|(word, _)| last.contains(word)).map(|(_, part)| part)
    };
    let row = |name: &&str| Some(((*name).to_owned(), part(name)?));
    let rows: Vec<(String, SplitPart)> = photos.iter().filter_map(row).collect();
    let count = |wanted: SplitPart| rows.iter().filter(|(_, part)| *part == wanted).count();
    let (train, test, clean) =
        (count(SplitPart::Train), count(SplitPart::Test), count(SplitPart::Validation));
    let other = photos.iter().find(|name| part(name).is_none());
    if train == 0 || test + clean == 0 {
        return Ok(None);
    }
    if other.is_none() && test > 0 {
        return Ok(Some(Split::new(&folder.join("(names of the photos)"), rows, true)));
    }
    Err(NamesError { train, test, clean, other: other.map(|other| (*other).to_owned()) })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(rows: &[&str], photos: &[&str]) -> Vec<SplitPart> {
        let rows = rows.iter().map(|row| ((*row).to_owned(), SplitPart::Test));
        let split = Split::new(Path::new("test.txt"), rows, false).of(photos);
        photos.iter().filter_map(|photo| split.part(photo)).collect()
    }

    #[test]
    fn a_row_holds_out_no_other_photo_of_the_same_last_part() {
        use SplitPart::{Test, Train};
        assert_eq!(part(&["cam0/003.jpg"], &["cam0/003.jpg", "cam1/003.jpg"]), [Test, Train]);
        assert_eq!(part(&["cam0/003"], &["cam0/003.jpg", "cam1/003.jpg"]), [Test, Train]);
        assert_eq!(part(&["003.jpg"], &["003.jpg", "cam1/003.jpg"]), [Test, Train]);
        assert_eq!(part(&["a.jpg"], &["a.jpg", "a.png"]), [Test, Train]);
        assert_eq!(part(&["cam0/003.jpg"], &["003.jpg", "cam0/003.jpg"]), [Train, Test]);
        assert_eq!(part(&["3.jpg"], &["13.jpg", "x/13.jpg"]), [Train, Train]);
    }

    #[test]
    fn a_row_is_found_by_what_is_left_of_its_name() {
        use SplitPart::{Test, Train};
        let rows = ["/home/x/images/cam0/a.JPG", "images/b", "c.png", "IMG.001"];
        let photos = ["cam0/a.jpg", "b.jpg", "in/c.jpg", "IMG.001.jpg", "IMG.002.jpg"];
        assert_eq!(part(&rows, &photos), [Test, Test, Test, Test, Train]);
        // The one with more in common is the row of a photo.
        let split =
            Split::new(Path::new("x"), [("a.jpg".to_owned(), Train), ("cam0/a.jpg".to_owned(), Test)], false);
        assert_eq!(split.of(&["images/cam0/a.jpg"]).part("images/cam0/a.jpg"), Some(Test));
    }
}
