//! A manifest as it is written, before anything is checked.

use std::collections::BTreeMap;
use std::path::PathBuf;

use segwild_pipeline::Until;
use serde::Deserialize;

use super::error::{MemorySizeError, SceneEntryError};

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct File {
    pub budget: BudgetTerms,
    pub defaults: Terms,
    pub scene: Vec<SceneEntry>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct BudgetTerms {
    pub cores: Option<u32>,
    pub memory: Option<Size>,
    pub accelerators: Option<u32>,
    pub patience: Option<f64>,
}

/// What may be set for one scene and for all.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct Terms {
    pub preset: Option<String>,
    pub priority: Option<i32>,
    pub cores: Option<u32>,
    pub memory: Option<Size>,
    pub accelerators: Option<u32>,
    pub accelerator: Option<String>,
    pub attempts: Option<u32>,
    pub until: Option<Stop>,
    pub settings: toml::Table,
}

#[derive(Debug, Deserialize)]
pub(super) struct SceneEntry {
    pub path: PathBuf,
    pub name: Option<String>,
    pub out: Option<PathBuf>,
    #[serde(flatten)]
    pub terms: Terms,
    /// All other keys; none, if there is no mistake.
    #[serde(flatten)]
    pub unknown: BTreeMap<String, toml::Value>,
}

/// Bytes, as a number or as text with a unit.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged)]
pub(super) enum Size {
    Bytes(u64),
    Text(String),
}

impl Size {
    pub fn bytes(&self) -> Result<u64, MemorySizeError> {
        match self {
            Size::Bytes(bytes) => Ok(*bytes),
            Size::Text(text) => read_size(text),
        }
    }
}

/// Reads `512 MiB`, `2.5 GB`, `1000000`.
fn read_size(text: &str) -> Result<u64, MemorySizeError> {
    let wrong = || MemorySizeError(text.to_owned());
    let split = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let number: f64 = text[..split].parse().map_err(|_| wrong())?;
    let unit = match text[split..].trim() {
        "" | "B" => 1.0,
        "KiB" => 1024.0,
        "MiB" => 1024f64.powi(2),
        "GiB" => 1024f64.powi(3),
        "TiB" => 1024f64.powi(4),
        "kB" => 1e3,
        "MB" => 1e6,
        "GB" => 1e9,
        "TB" => 1e12,
        _ => return Err(wrong()),
    };
    Ok((number * unit) as u64)
}

/// Where a scene is to stop: a stage, or a step of the training.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged)]
pub(super) enum Stop {
    Step(u32),
    Text(String),
}

impl Stop {
    pub fn read(&self) -> Result<Until, SceneEntryError> {
        let text = match self {
            Stop::Step(step) => step.to_string(),
            Stop::Text(text) => text.clone(),
        };
        let wrong = |reason| SceneEntryError::Until { until: text.clone(), reason };
        text.parse().map_err(wrong)
    }
}

/// The settings of a scene: the defaults', then its own.
pub(super) fn settings(defaults: &Terms, own: &Terms) -> Result<BTreeMap<String, String>, SceneEntryError> {
    let mut all = BTreeMap::new();
    for (preset, table) in [(&defaults.preset, &defaults.settings), (&own.preset, &own.settings)] {
        if let Some(preset) = preset {
            all.insert("preset".to_owned(), preset.clone());
        }
        for (name, value) in table {
            let value = match value {
                toml::Value::String(text) => text.clone(),
                toml::Value::Table(_) | toml::Value::Array(_) => {
                    return Err(SceneEntryError::NotSingle(name.clone()));
                }
                other => other.to_string(),
            };
            all.insert(name.replace('-', "_"), value);
        }
    }
    // What a scene may use of the machine is set once, for the batch to keep account of.
    for (setting, instead) in [("threads", "cores"), ("memory_budget", "memory")] {
        if all.contains_key(setting) {
            return Err(SceneEntryError::Reserved { setting, instead });
        }
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amounts_of_memory_are_read() {
        for (text, bytes) in [("512 MiB", 512 << 20), ("1.5GiB", 3 << 29), ("2 GB", 2_000_000_000), ("7", 7)]
        {
            assert_eq!(read_size(text), Ok(bytes));
        }
    }
}
