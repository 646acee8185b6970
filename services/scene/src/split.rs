//! NeRF-W's split files for Photo Tourism: tab-separated `filename id split dataset`.

use crate::SceneError;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What the split says of one photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    Train,
    Test,
    /// A row without an id: the reconstruction has no pose of the photo.
    NoPose,
}

/// A split file.
#[derive(Clone, Debug)]
pub(crate) struct Split {
    pub(crate) path: PathBuf,
    pub(crate) rows: BTreeMap<String, Part>,
}

impl Split {
    pub(crate) fn read(path: &Path) -> Result<Split, SceneError> {
        let bytes = std::fs::read(path).map_err(SceneError::io(path))?;
        let text =
            String::from_utf8(bytes).map_err(|_| SceneError::invalid(path, "text", "it is not UTF-8"))?;
        let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
        let (_, head) =
            lines.next().ok_or_else(|| SceneError::invalid(path, "line 1", "the file is empty"))?;
        let heads: Vec<&str> = head.split('\t').map(str::trim).collect();
        let column = |name: &str| {
            heads.iter().position(|h| *h == name).ok_or_else(|| {
                let reason =
                    format!("there is no column `{name}`; a split has filename, id and split, tab-separated");
                SceneError::invalid(path, "line 1", reason)
            })
        };
        let (name, id, split) = (column("filename")?, column("id")?, column("split")?);
        let mut rows = BTreeMap::new();
        for (i, line) in lines {
            let cells: Vec<&str> = line.split('\t').map(str::trim).collect();
            let cell = |c: usize| cells.get(c).copied().unwrap_or("");
            let invalid = |reason: String| SceneError::invalid(path, format!("line {}", i + 1), reason);
            if cell(name).is_empty() {
                return Err(invalid("the row names no photo".into()));
            }
            let part = match (cell(id), cell(split)) {
                ("", _) => Part::NoPose,
                (_, "train") => Part::Train,
                (_, "test") => Part::Test,
                (_, other) => return Err(invalid(format!("`{other}` is neither train nor test"))),
            };
            if rows.insert(cell(name).to_owned(), part).is_some() {
                return Err(invalid(format!("photo {} is listed twice", cell(name))));
            }
        }
        Ok(Split { path: path.to_owned(), rows })
    }

    /// What the split says of a photo, known by its whole name or by the last part of it.
    pub(crate) fn part(&self, name: &str) -> Option<Part> {
        let last = name.rsplit('/').next().unwrap_or(name);
        self.rows.get(name).or_else(|| self.rows.get(last)).copied()
    }
}
