//! `history.jsonl`: loss, PSNR and splats of the training, a line every few steps.

use crate::{RunError, RunFolder};
use segwild_flow::files;
use serde::{Deserialize, Serialize};
use wincode::{SchemaRead, SchemaWrite};

/// Kind of the cache's records of how a training went.
pub const HISTORY: &str = "history";

/// A line of the history.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SchemaRead, SchemaWrite)]
pub struct Moment {
    /// Steps done.
    pub step: u32,
    /// Mean loss since the line before.
    pub loss: f32,
    /// Mean PSNR of the photos' counted pixels since the line before, in dB.
    pub psnr: f32,
    /// Splats.
    pub splats: usize,
    /// Mean share of the photos left out as transient.
    pub left_out: f32,
}

impl RunFolder {
    /// How the training went until now.
    pub fn moments(&self) -> Vec<Moment> {
        read(self)
    }
}

/// Reads the history; lines that are cut short are left out.
pub fn read(folder: &RunFolder) -> Vec<Moment> {
    let text = segwild_flow::files::read_plain(&folder.history()).unwrap_or_default();
    let text = String::from_utf8_lossy(&text);
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

/// Adds a line.
pub fn append(folder: &RunFolder, moment: &Moment) -> Result<(), RunError> {
    let path = folder.history();
    let line = serde_json::to_string(moment).unwrap_or_default();
    Ok(files::append_line(&path, &line)?)
}

/// Removes the lines after the step that training continues from.
pub fn trim(folder: &RunFolder, step: u32) -> Result<(), RunError> {
    let kept: Vec<Moment> = read(folder).into_iter().filter(|m| m.step <= step).collect();
    replace(folder, &kept)
}

/// Replaces the history by that of a training that is in the cache.
pub fn replace(folder: &RunFolder, moments: &[Moment]) -> Result<(), RunError> {
    let text: String =
        moments.iter().filter_map(|m| serde_json::to_string(m).ok()).map(|line| line + "\n").collect();
    folder.write("history.jsonl", text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    #[test]
    fn going_on_from_a_step_forgets_what_came_after() {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(dir.path()).unwrap();
        let at = |step| Moment { step, loss: 0.1, psnr: 20.0, splats: 5, left_out: 0.0 };
        for step in [20, 40, 60] {
            append(&folder, &at(step)).unwrap();
        }
        std::fs::OpenOptions::new()
            .append(true)
            .open(folder.history())
            .unwrap()
            .write_all(b"{\"step\": 8")
            .unwrap();
        assert_eq!(read(&folder).len(), 3, "a line that was cut short is left out");
        trim(&folder, 40).unwrap();
        assert_eq!(read(&folder), vec![at(20), at(40)]);
    }
}
