//! The files of a folder.

use std::fs;
use std::path::{Path, PathBuf};

use segwild_flow::FileError;

use super::error::{ArtefactError, UnfitFolderError};
use super::manifest::{FolderLimits, fit};

/// A file that was found.
#[derive(Clone, Debug)]
pub(super) struct FoundFile {
    /// Its path in the folder, with `/`.
    pub path: String,
    /// Where its bytes are.
    pub source: PathBuf,
}

struct Open {
    /// The folders from the top to this one without links: one that leads back into them is a circle.
    above: Vec<PathBuf>,
    folder: PathBuf,
    /// Its path, with a `/` at its end, or nothing.
    prefix: String,
}

/// The plain files of a folder and of the folders below it, of those that `wanted` accepts by path. Links are followed.
/// What is neither a file nor a folder is left out.
///
/// # Errors
/// When a folder cannot be read, a name has no place in a manifest, links form a circle, or there are too many files.
pub(super) fn files(
    top: &Path,
    limits: &FolderLimits,
    wanted: &dyn Fn(&str) -> bool,
) -> Result<Vec<FoundFile>, ArtefactError> {
    let unfit = |path: &Path, reason| ArtefactError::Unfit { path: path.into(), reason };
    let mut found = Vec::new();
    let mut open = vec![Open { above: Vec::new(), folder: top.to_owned(), prefix: String::new() }];
    while let Some(Open { mut above, folder, prefix }) = open.pop() {
        let real = fs::canonicalize(&folder).map_err(|e| FileError::new("read", &folder, e))?;
        if above.contains(&real) {
            return Err(unfit(&folder, UnfitFolderError::Circle));
        }
        above.push(real);
        for entry in fs::read_dir(&folder).map_err(|e| FileError::new("read", &folder, e))? {
            let entry = entry.map_err(|e| FileError::new("read", &folder, e))?;
            let source = entry.path();
            let name = entry.file_name();
            let path = format!("{prefix}{}", name.to_string_lossy());
            if !wanted(&path) {
                continue;
            }
            // A link that leads nowhere, and a file that was removed meanwhile.
            let Ok(data) = fs::metadata(&source) else { continue };
            if !data.is_file() && !data.is_dir() {
                continue;
            }
            if name.to_str().is_none() {
                return Err(unfit(&source, UnfitFolderError::Name));
            }
            fit(&path, limits.depth).map_err(|reason| unfit(&source, UnfitFolderError::Path(reason)))?;
            if data.is_dir() {
                open.push(Open { above: above.clone(), folder: source, prefix: path + "/" });
                continue;
            }
            found.push(FoundFile { path, source });
            if found.len() > limits.files {
                return Err(unfit(top, UnfitFolderError::Files(limits.files)));
            }
        }
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(found)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    fn paths(top: &Path) -> Result<Vec<String>, String> {
        let found = files(top, &FolderLimits::default(), &|_| true).map_err(|e| e.to_string())?;
        Ok(found.into_iter().map(|found| found.path).collect())
    }

    #[test]
    fn links_are_followed_and_a_circle_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let (top, photos) = (dir.path().join("scene"), dir.path().join("photos"));
        for folder in [&top, &photos] {
            fs::create_dir(folder).unwrap();
        }
        fs::write(photos.join("a.jpg"), "a").unwrap();
        symlink(&photos, top.join("images")).unwrap();
        symlink(photos.join("a.jpg"), top.join("b.jpg")).unwrap();
        symlink("gone", top.join("c.jpg")).unwrap();
        let _socket = std::os::unix::net::UnixListener::bind(top.join("socket")).unwrap();
        assert_eq!(paths(&top).unwrap(), ["b.jpg", "images/a.jpg"]);
        symlink(&top, photos.join("back")).unwrap();
        assert!(paths(&top).unwrap_err().contains("link to a folder in which it lies"));
    }

    #[test]
    fn names_that_no_manifest_takes_are_named() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("a\\b.jpg"), "a").unwrap();
        assert!(paths(dir.path()).unwrap_err().contains("names no file inside"));
    }
}
