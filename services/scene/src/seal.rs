//! Files that must stay as they are while they are used.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// State of some files when a scene was opened. Artefacts are keyed by the photos' bytes, so a photo that somebody overwrites or
/// moves must not be taken for the one that was there.
///
/// ```
/// # let dir = tempfile::tempdir()?;
/// let photo = dir.path().join("photo.jpg");
/// std::fs::write(&photo, "as taken")?;
/// let seal = segwild_scene::Seal::on([photo.as_path()]);
/// assert_eq!(seal.broken(), None);
/// std::fs::write(&photo, "as edited")?;
/// assert_eq!(seal.broken(), Some(photo.as_path()));
/// # Ok::<_, std::io::Error>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Seal(Vec<(PathBuf, Option<Stamp>)>);

/// Length and time of the last change; a file without these is one that cannot be seen.
type Stamp = (u64, Option<SystemTime>);

fn stamp(path: &Path) -> Option<Stamp> {
    std::fs::metadata(path).ok().map(|m| (m.len(), m.modified().ok()))
}

impl Seal {
    /// Remembers these files as they are now.
    pub fn on<'a>(files: impl IntoIterator<Item = &'a Path>) -> Seal {
        Seal(files.into_iter().map(|f| (f.to_owned(), stamp(f))).collect())
    }

    /// The first file that is no longer what it was.
    pub fn broken(&self) -> Option<&Path> {
        self.0.iter().find(|(path, was)| stamp(path) != *was).map(|(path, _)| path.as_path())
    }
}
