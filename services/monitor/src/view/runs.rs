//! Looking at many runs again and again.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use segwild_pipeline::RunFolder;

use super::Disk;
use super::folder::ViewError;
use super::run::{RunView, selections};

/// Length and time of last change of each file that says how a run is; `None` for one that is not there.
type FileMarks = [Option<(u64, Option<SystemTime>)>; 3];

/// The runs that were read before. One that nobody works on, and whose files are as they were, is not read again:
/// a batch of hundreds of scenes works on a few at a time.
#[derive(Default)]
pub struct Runs {
    seen: BTreeMap<PathBuf, (FileMarks, RunView)>,
}

impl Runs {
    /// A run's folder as it is at a time.
    ///
    /// # Errors
    /// As [`RunView::read`].
    pub fn view(&mut self, path: &Path, now: f64) -> Result<RunView, ViewError> {
        // Taken before reading: what changes in between is read again at the next read.
        let mark = mark(path);
        if let Some((known, view)) = self.seen.get(path)
            && *known == mark
        {
            let selections = selections(&RunFolder::at(path));
            return Ok(RunView { disk: Disk::of(path), selections, ..view.later(now) });
        }
        let view = RunView::read(path, now)?;
        if view.running {
            self.seen.remove(path);
        } else {
            self.seen.insert(path.to_owned(), (mark, view.clone()));
        }
        Ok(view)
    }
}

fn mark(folder: &Path) -> FileMarks {
    // Who starts to work on a run writes its name into the lock first.
    ["run.lock", "run.sqlite", "run.sqlite-wal"].map(|name| {
        let data = std::fs::metadata(folder.join(name)).ok()?;
        // Readers make an empty log where there is none.
        (data.len() > 0).then(|| (data.len(), data.modified().ok()))
    })
}
