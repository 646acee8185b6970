//! Checks that everything in a folder stays in it: a folder from somebody else may hold links.

use std::fs;
use std::path::{Path, PathBuf};

/// An entry of a folder that leads out of it, or is neither a file nor a folder.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct Stray {
    /// Path of the entry.
    pub path: PathBuf,
    /// What it is, and what to do.
    pub reason: String,
}

/// Checks the entries of a folder whose names `ours` accepts, and everything below them: a link must lead to something in the
/// folder, everything else must be a file or a folder. A missing folder counts as an empty one.
///
/// ```
/// let dir = tempfile::tempdir().unwrap();
/// std::fs::create_dir(dir.path().join("cache")).unwrap();
/// assert_eq!(segwild_files::stays_inside(dir.path(), |_| true), Ok(()));
/// # #[cfg(unix)] {
/// std::os::unix::fs::symlink("/etc", dir.path().join("cache/sky.d")).unwrap();
/// let stray = segwild_files::stays_inside(dir.path(), |_| true).unwrap_err();
/// assert!(stray.to_string().contains("sky.d: it is a link to /etc"));
/// # }
/// ```
///
/// # Errors
/// Names the first entry that does not stay inside.
pub fn stays_inside(folder: &Path, ours: impl Fn(&str) -> bool) -> Result<(), Stray> {
    let Ok(root) = fs::canonicalize(folder) else { return Ok(()) };
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        // What cannot be read cannot be written through either: the writer will say so.
        for entry in fs::read_dir(&next).into_iter().flatten().flatten() {
            let name = entry.file_name();
            if next == folder && !ours(&name.to_string_lossy()) {
                continue;
            }
            let (path, Ok(kind)) = (entry.path(), entry.file_type()) else { continue };
            if kind.is_dir() {
                open.push(path);
            } else if kind.is_symlink() {
                leads_inside(&root, path)?;
            } else if !kind.is_file() {
                let reason = "it is neither a file nor a folder: remove it".into();
                return Err(Stray { path, reason });
            }
        }
    }
    Ok(())
}

fn leads_inside(root: &Path, path: PathBuf) -> Result<(), Stray> {
    if fs::canonicalize(&path).is_ok_and(|target| target.starts_with(root)) {
        return Ok(());
    }
    let target = fs::read_link(&path).unwrap_or_default();
    let reason = format!(
        "it is a link to {}, and nothing is written through a link that leads out of the folder: put what it stands for in \
         its place",
        target.display()
    );
    Err(Stray { path, reason })
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    #[test]
    fn a_link_out_of_the_folder_and_one_that_leads_nowhere_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path().join("run");
        fs::create_dir_all(run.join("selections/a")).unwrap();
        let check = || stays_inside(&run, |name| name != "theirs").map_err(|stray| stray.path);
        symlink("a", run.join("selections/b")).unwrap();
        symlink("/etc", run.join("theirs")).unwrap();
        assert_eq!(check(), Ok(()), "a link inside, and one that is none of ours");
        for target in ["/etc", "../../..", "gone"] {
            let link = run.join("selections/a/masks");
            symlink(target, &link).unwrap();
            assert_eq!(check(), Err(link.clone()), "{target}");
            fs::remove_file(&link).unwrap();
        }
    }

    #[test]
    fn a_socket_in_a_folder_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let socket = dir.path().join("run.lock");
        let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
        assert_eq!(stays_inside(dir.path(), |_| true).unwrap_err().path, socket);
    }
}
