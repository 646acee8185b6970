//! Checks that the files of a selection are as they were written: `files.json` beside them has the hash of each.

use crate::{RunError, RunFolder};
use segwild_flow::files::{self, name};
use segwild_flow::{FileError, codec};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The list in a selection's folder.
const LIST: &str = "files.json";
/// The summary, which is written after the list and therefore not on it.
const LAST: &str = "summary.json";

/// A file of a selection that is not as it was written.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct DamagedFile {
    /// The selection.
    pub selection: String,
    /// The file.
    pub file: PathBuf,
    /// What is wrong with it.
    pub reason: String,
}

impl From<DamagedFile> for RunError {
    fn from(DamagedFile { selection, file, reason }: DamagedFile) -> RunError {
        let again = format!(
            "`segwild segment RUN --name {selection} --prompts RUN/selections/{selection}/prompts.json` makes the selection \
             again"
        );
        RunError::Folder { path: file, reason: format!("{reason}; {again}") }
    }
}

/// Writes the list of a selection that is whole in `folder`, but for its summary.
pub(crate) fn write_list(folder: &Path) -> Result<(), RunError> {
    let mut hashes = BTreeMap::new();
    for file in files_of(folder)? {
        let path = folder.join(&file);
        let bytes = files::read_plain(&path).map_err(|e| FileError::new("read", &path, e))?;
        hashes.insert(file, blake3::hash(&bytes).to_hex().to_string());
    }
    let path = folder.join(LIST);
    let text = serde_json::to_vec_pretty(&hashes)
        .map_err(|e| RunError::Folder { path: path.clone(), reason: e.to_string() })?;
    Ok(files::write_atomic(&path, &text)?)
}

/// The files in a folder and below it, with `/` between the parts of a name.
fn files_of(folder: &Path) -> Result<Vec<String>, FileError> {
    let (mut found, mut open) = (Vec::new(), vec![String::new()]);
    while let Some(next) = open.pop() {
        let path = folder.join(&next);
        let failed = |e| FileError::new("read", &path, e);
        for entry in fs::read_dir(&path).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let name = format!("{next}{}", entry.file_name().to_string_lossy());
            match entry.file_type().map_err(failed)?.is_dir() {
                true => open.push(name + "/"),
                false if name != LIST && name != LAST => found.push(name),
                false => {}
            }
        }
    }
    found.sort();
    Ok(found)
}

/// The hashes of a selection's files; `None` for one of an earlier version, which has no list.
pub(crate) struct Intact {
    selection: String,
    folder: PathBuf,
    hashes: Option<BTreeMap<String, String>>,
}

impl Intact {
    /// Reads the list.
    pub fn of(run: &RunFolder, selection: &str) -> Result<Intact, DamagedFile> {
        let folder = run.selection(selection);
        let damaged =
            |reason: String| DamagedFile { selection: selection.into(), file: folder.join(LIST), reason };
        let hashes: Option<BTreeMap<String, String>> = match files::read_plain(&folder.join(LIST)) {
            Ok(text) => {
                Some(serde_json::from_slice(&text).map_err(|e| damaged(format!("it is damaged: {e}")))?)
            }
            Err(_) => None,
        };
        // What is on the list is read from there, and nothing outside of the selection is.
        let outside = |file: &String| file.split('/').any(|part| !name::is_plain(part));
        match hashes.iter().flat_map(BTreeMap::keys).find(|file| outside(file)) {
            Some(file) => {
                Err(damaged(format!("it names `{}`, which is no file of a selection", name::one_line(file))))
            }
            None => Ok(Intact { selection: selection.into(), folder, hashes }),
        }
    }

    /// Refuses a file that is not as it was written. One that the list does not know is none of the selection's.
    pub fn check(&self, file: &Path) -> Result<(), DamagedFile> {
        let name = file.strip_prefix(&self.folder).unwrap_or(file).to_string_lossy().replace('\\', "/");
        match self.hashes.as_ref().and_then(|hashes| hashes.get(&name)) {
            Some(hash) => self.compare(&name, hash),
            None => Ok(()),
        }
    }

    fn compare(&self, name: &str, hash: &str) -> Result<(), DamagedFile> {
        let file = self.folder.join(name);
        let reason = match files::read_plain(&file) {
            Ok(bytes) if blake3::hash(&bytes).to_hex().as_str() == hash => return Ok(()),
            Ok(_) => "it is not as it was written: its hash does not fit".into(),
            Err(error) => format!("it was written and cannot be read: {error}"),
        };
        Err(DamagedFile { selection: self.selection.clone(), file, reason })
    }

    /// All that are not as they were written.
    fn damaged(&self) -> Vec<DamagedFile> {
        self.hashes.iter().flatten().filter_map(|(name, hash)| self.compare(name, hash).err()).collect()
    }

    /// How many files are on the list.
    fn count(&self) -> usize {
        self.hashes.as_ref().map_or(0, BTreeMap::len)
    }
}

/// Compares every file of a run's selections with what was written: how many there are, and those that differ.
pub fn verify_selections(run: &RunFolder) -> (usize, Vec<DamagedFile>) {
    let (mut count, mut damaged) = (0, Vec::new());
    for selection in run.selections() {
        match Intact::of(run, &selection) {
            Ok(intact) => {
                count += intact.count();
                damaged.extend(intact.damaged());
                damaged.extend(unreadable(run, &selection, &intact));
            }
            Err(list) => damaged.push(list),
        }
    }
    (count, damaged)
}

/// A record of a selection of an earlier version, which has no list, says itself whether it is whole.
fn unreadable(run: &RunFolder, selection: &str, intact: &Intact) -> Option<DamagedFile> {
    let file = run.selection(selection).join("selection.bin");
    let bytes = files::read_plain(&file).ok().filter(|_| intact.hashes.is_none())?;
    let reason = codec::open(&bytes).err()?.to_string();
    Some(DamagedFile { selection: selection.into(), file, reason })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn selection() -> (tempfile::TempDir, RunFolder, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let run = RunFolder::create(dir.path()).unwrap();
        let folder = run.selection("statue");
        for file in ["object.ply", "masks/a/b.png", "prompts.json", LAST] {
            files::write_atomic(&folder.join(file), file.as_bytes()).unwrap();
        }
        write_list(&folder).unwrap();
        (dir, run, folder)
    }

    #[test]
    fn a_damaged_file_of_a_selection_is_named_with_what_makes_it_again() {
        let (_dir, run, folder) = selection();
        assert_eq!(verify_selections(&run), (3, Vec::new()));
        fs::write(folder.join("masks/a/b.png"), "another").unwrap();
        fs::remove_file(folder.join("object.ply")).unwrap();
        let (_, damaged) = verify_selections(&run);
        let names: Vec<&Path> = damaged.iter().map(|d| d.file.as_path()).collect();
        assert_eq!(names, [folder.join("masks/a/b.png"), folder.join("object.ply")]);
        let intact = Intact::of(&run, "statue").unwrap();
        assert!(intact.check(&folder.join("prompts.json")).is_ok());
        let message = RunError::from(intact.check(&folder.join("object.ply")).unwrap_err()).to_string();
        assert!(message.contains("object.ply") && message.contains("--name statue --prompts"), "{message}");
    }

    #[test]
    fn a_forged_list_reads_nothing_outside_of_the_selection() {
        let (_dir, run, folder) = selection();
        for name in ["../../run.sqlite", "/etc/passwd", "masks/../../x", ""] {
            fs::write(folder.join(LIST), serde_json::json!({ name: "00" }).to_string()).unwrap();
            let (count, damaged) = verify_selections(&run);
            assert!(
                count == 0 && damaged.len() == 1 && damaged[0].file.ends_with(LIST),
                "{name}: {damaged:?}"
            );
        }
        fs::write(folder.join(LIST), "{\"a\": 3}").unwrap();
        assert_eq!(verify_selections(&run).1.len(), 1);
    }
}
