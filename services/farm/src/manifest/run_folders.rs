//! Where scenes run: no two in one folder, by whatever path it is called.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Component, Path, PathBuf};

/// A scene would run in the folder of another one.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FolderTaken {
    /// Both name the same folder.
    #[error("two scenes run in {}", .0.display())]
    Same(PathBuf),
    /// They name one folder by two paths.
    #[error("two scenes run in one folder: {} is {} of `{scene}`", out.display(), other.display())]
    OtherPath {
        /// The scene's folder.
        out: PathBuf,
        /// The folder of the other scene.
        other: PathBuf,
        /// The other scene.
        scene: String,
    },
    /// One folder holds the other.
    #[error("{} and {} of `{scene}` lie in one another", out.display(), other.display())]
    Nested {
        /// The scene's folder.
        out: PathBuf,
        /// The folder of the other scene.
        other: PathBuf,
        /// The other scene.
        scene: String,
    },
}

/// The run folders that are taken, by where they truly are, capitals aside.
#[derive(Default)]
pub(super) struct RunFolders(BTreeMap<PathBuf, (String, PathBuf)>);

impl RunFolders {
    /// Takes a folder for a scene.
    ///
    /// # Errors
    /// Names the scene that runs in the same folder, or in one of the two that hold one another.
    pub fn take(&mut self, scene: &str, out: &Path) -> Result<(), FolderTaken> {
        let key = folded(&real(out));
        let above = key.ancestors().find_map(|above| self.0.get_key_value(above));
        // Paths are in order of their parts: what lies in a folder comes right after it.
        let below = || self.0.range(key.clone()..).next().filter(|(taken, _)| taken.starts_with(&key));
        let near = above.or_else(below);
        if let Some((taken, (scene, other))) = near {
            let (same, out) = (other.as_os_str() == out.as_os_str(), out.to_owned());
            let (other, scene) = (other.clone(), scene.clone());
            return Err(match *taken == key {
                true if same => FolderTaken::Same(out),
                true => FolderTaken::OtherPath { out, other, scene },
                false => FolderTaken::Nested { out, other, scene },
            });
        }
        self.0.insert(key, (scene.to_owned(), out.to_owned()));
        Ok(())
    }
}

/// Where a path leads: as much of it as is there with its links followed, the rest with `.` and `..` taken away.
fn real(path: &Path) -> PathBuf {
    let mut at = PathBuf::new();
    for part in path.components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir => {
                at.pop();
            }
            other => at.push(other),
        }
        // One part after the other: `..` after a link leads out of what the link stands for.
        if let Ok(found) = std::fs::canonicalize(&at) {
            at = found;
        }
    }
    at
}

/// The same for two paths that differ in capitals only: one folder on some systems.
fn folded(path: &Path) -> PathBuf {
    path.components().map(|part| OsString::from(part.as_os_str().to_string_lossy().to_lowercase())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Which of the folders is refused, and why.
    fn refused(outs: &[&Path]) -> Option<(usize, String)> {
        let mut taken = RunFolders::default();
        let take = |(i, out): (usize, &&Path)| {
            taken.take(&format!("s{i}"), out).err().map(|why| (i, why.to_string()))
        };
        outs.iter().enumerate().find_map(take)
    }

    #[test]
    fn one_folder_under_two_paths_is_not_run_in_twice() {
        let dir = tempfile::tempdir().unwrap();
        let at = |path: &str| dir.path().join(path);
        let first = at("o/z");
        for same in ["o/../o/z", "o/./z", "./o/z/", "o/x/../z", "O/Z", "o/../O/z"] {
            let (at, why) = refused(&[&first, &at(same)]).expect(same);
            assert!(at == 1 && why.contains("`s0`") && why.contains("one folder"), "{same}: {why}");
        }
        let (_, why) = refused(&[&first, &at("o/z/cache")]).unwrap();
        assert!(why.contains("lie in one another"), "{why}");
        assert_eq!(refused(&[&first, &at("o/zz"), &at("p/z"), &at("o/y")]), None);
    }

    #[cfg(unix)]
    #[test]
    fn one_folder_reached_through_a_link_is_not_run_in_twice() {
        let dir = tempfile::tempdir().unwrap();
        let at = |path: &str| dir.path().join(path);
        std::fs::create_dir_all(at("disk/o")).unwrap();
        std::os::unix::fs::symlink(at("disk/o"), at("l")).unwrap();
        assert_eq!(refused(&[&at("disk/o/z"), &at("l/z")]).unwrap().0, 1);
        assert_eq!(
            refused(&[&at("disk/z"), &at("l/../z")]).unwrap().0,
            1,
            "`..` of a link is beside what it leads to"
        );
        assert_eq!(refused(&[&at("z"), &at("l/../z")]), None);
    }
}
