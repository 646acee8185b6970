//! Folders in which the readers find their files.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

static ROOT: OnceLock<PathBuf> = OnceLock::new();

/// Where the readers' files lie; by default in a temporary folder that stays. To be called before the first reader.
pub fn keep_files_in(root: &Path) {
    // Only the first one counts: files are there already.
    let _ = ROOT.set(root.to_owned());
}

/// A folder of this process, made if it is not there.
///
/// # Panics
/// Where no folder can be made.
pub(crate) fn folder(name: &str) -> PathBuf {
    let default = || std::env::temp_dir().join(format!("segwild-fuzz-{}", std::process::id()));
    let folder = ROOT.get_or_init(default).join(name);
    std::fs::create_dir_all(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    folder
}

/// Writes a file of the yard.
///
/// # Panics
/// Where it cannot be written.
pub(crate) fn put(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
}

/// Reads a file of the yard.
///
/// # Panics
/// Where it cannot be read.
pub(crate) fn take(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Copies a folder with all that is in it.
///
/// # Panics
/// Where it cannot be copied.
pub(crate) fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap_or_else(|e| panic!("{}: {e}", to.display()));
    for entry in std::fs::read_dir(from).into_iter().flatten().flatten() {
        let (path, to) = (entry.path(), to.join(entry.file_name()));
        match path.is_dir() {
            true => copy(&path, &to),
            false => put(&to, &take(&path)),
        }
    }
}
