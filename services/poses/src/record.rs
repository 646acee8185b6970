//! `poses.json`: what the poses were made from, and what came out.

use crate::PosesError;
use segwild_flow::files;
use segwild_scene::{Skipped, file_digest};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::Path;
use std::time::UNIX_EPOCH;

/// Its name.
pub(crate) const RECORD: &str = "poses.json";

/// A file as it was when something was made of it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct FileStamp {
    /// Bytes.
    bytes: u64,
    /// Time of the last change, in milliseconds since 1970, where the system reports it.
    changed: Option<u64>,
    /// BLAKE3 of its content.
    pub digest: String,
}

impl FileStamp {
    /// The stamp of a file. Where length and time are those of an earlier stamp, its content is taken for the same.
    pub fn of(path: &Path, before: Option<&FileStamp>) -> std::io::Result<FileStamp> {
        let data = std::fs::metadata(path)?;
        let since =
            |time: std::time::SystemTime| Some(time.duration_since(UNIX_EPOCH).ok()?.as_millis() as u64);
        let (bytes, changed) = (data.len(), data.modified().ok().and_then(since));
        if let Some(before) = before.filter(|b| b.bytes == bytes && b.changed == changed && changed.is_some())
        {
            return Ok(before.clone());
        }
        Ok(FileStamp { bytes, changed, digest: file_digest(path)? })
    }
}

/// A model that COLMAP made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ModelSize {
    /// Its number, which is the name of its folder.
    pub number: u32,
    /// Photos with a pose.
    pub photos: usize,
    /// Points.
    pub points: usize,
}

/// What came out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct PosesDone {
    /// Key of all that it was made from.
    pub key: String,
    /// The program that made it.
    pub colmap: String,
    /// The models, the largest first; the first one is used.
    pub models: Vec<ModelSize>,
    /// Photos without a pose in it, and why.
    pub unposed: Vec<Skipped>,
}

/// The record of the folder.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct PosesRecord {
    /// Key of all that features depend on beside the photos.
    pub features: String,
    /// Photos whose features may stand in the database.
    pub photos: BTreeMap<String, FileStamp>,
    /// The video that the photos were taken out of.
    pub video: Option<FileStamp>,
    /// Key of what the frames in the folder were taken by; empty where there are none.
    #[serde(default)]
    pub frames: String,
    /// What came out, once it did.
    pub done: Option<PosesDone>,
}

impl PosesRecord {
    /// The record in a folder; `None` where there is none.
    pub fn read(folder: &Path) -> Result<Option<PosesRecord>, PosesError> {
        let path = folder.join(RECORD);
        let damaged = |reason: String| PosesError::Record { path: path.clone(), reason };
        let bytes = match files::read_plain(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            read => read.map_err(|error| damaged(error.to_string()))?,
        };
        serde_json::from_slice(&bytes).map(Some).map_err(|error| damaged(error.to_string()))
    }

    /// Writes it.
    pub fn write(&self, folder: &Path) -> Result<(), PosesError> {
        let path = folder.join(RECORD);
        let bytes = serde_json::to_vec_pretty(self)
            .map_err(|error| PosesError::Record { path: path.clone(), reason: error.to_string() })?;
        Ok(files::write_atomic(&path, &bytes)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_the_same_length_and_time_is_not_read_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.jpg");
        std::fs::write(&path, "abc").unwrap();
        let first = FileStamp::of(&path, None).unwrap();
        let known = FileStamp { digest: "known".into(), ..first.clone() };
        assert_eq!(FileStamp::of(&path, Some(&known)).unwrap(), known);
        std::fs::write(&path, "abcd").unwrap();
        let changed = FileStamp::of(&path, Some(&known)).unwrap();
        assert!(changed.digest != "known" && changed.digest != first.digest);
    }

    #[test]
    fn a_damaged_record_is_an_error_and_a_missing_one_is_none() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(PosesRecord::read(dir.path()).unwrap(), None);
        let record = PosesRecord { features: "f".into(), ..PosesRecord::default() };
        record.write(dir.path()).unwrap();
        assert_eq!(PosesRecord::read(dir.path()).unwrap(), Some(record));
        std::fs::write(dir.path().join(RECORD), "{").unwrap();
        assert!(PosesRecord::read(dir.path()).unwrap_err().to_string().contains("poses.json"));
    }
}
