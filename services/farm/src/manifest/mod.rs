//! The scenes of a batch, as a file.
//!
//! ```toml
//! [budget]                     # what may be used of this machine; by default all cores and 80 % of the memory
//! cores = 4
//! memory = "8 GiB"
//! accelerators = 1
//! patience = 3600              # seconds without any progress after which a scene's process is ended and tried again
//!
//! [defaults]                   # for every scene that does not say otherwise
//! preset = "draft"             # short for settings.preset
//! attempts = 3
//! settings = { size = 320 }    # any setting of docs/settings.md
//!
//! [[scene]]
//! path = "photos/liberty"      # relative to this file
//! name = "liberty"             # default: the folder's name
//! out = "runs/liberty"         # default: NAME in the batch folder
//! priority = 5                 # higher goes first
//! cores = 2                    # default: the budget's, shared evenly
//! memory = "1 GiB"             # default: estimated
//! accelerators = 0
//! settings = { steps = 4000 }
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use segwild_pipeline::Settings;
use serde::{Deserialize, Serialize};

use crate::job::{Job, Needs, Retry};
use crate::machine;

/// Why a manifest cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is not what it should be.
    #[error("{}: {reason}", file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// What is wrong in it.
        reason: String,
    },
    /// A scene of it is not what it should be.
    #[error("{}: scene `{scene}`: {reason}", file.display())]
    Scene {
        /// The file.
        file: PathBuf,
        /// The scene.
        scene: String,
        /// What is wrong.
        reason: String,
    },
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct File {
    budget: Budget,
    defaults: Terms,
    scene: Vec<Entry>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Budget {
    cores: Option<u32>,
    memory: Option<Size>,
    accelerators: Option<u32>,
    patience: Option<f64>,
}

/// What may be said for one scene and for all.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Terms {
    preset: Option<String>,
    priority: Option<i32>,
    cores: Option<u32>,
    memory: Option<Size>,
    accelerators: Option<u32>,
    attempts: Option<u32>,
    settings: toml::Table,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    path: PathBuf,
    name: Option<String>,
    out: Option<PathBuf>,
    preset: Option<String>,
    priority: Option<i32>,
    cores: Option<u32>,
    memory: Option<Size>,
    accelerators: Option<u32>,
    attempts: Option<u32>,
    #[serde(default)]
    settings: toml::Table,
}

/// Bytes, as a number or as text with a unit.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged)]
enum Size {
    Bytes(u64),
    Text(String),
}

impl Size {
    fn bytes(&self) -> Result<u64, String> {
        match self {
            Size::Bytes(bytes) => Ok(*bytes),
            Size::Text(text) => read_size(text),
        }
    }
}

/// Reads `512 MiB`, `2.5 GB`, `1000000`.
fn read_size(text: &str) -> Result<u64, String> {
    let wrong = || format!("`{text}` is no amount of memory: write `512 MiB` or `8 GiB`");
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

/// A scene of a batch: the payload of its job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneJob {
    /// Its name.
    pub name: String,
    /// The photos and cameras.
    pub path: PathBuf,
    /// The run folder.
    pub out: PathBuf,
    /// The settings that were given, by name; the others have their preset's defaults.
    pub settings: BTreeMap<String, String>,
}

impl SceneJob {
    /// Its effective settings.
    ///
    /// # Errors
    /// In words, when a name or a value does not fit.
    pub fn effective(&self) -> Result<Settings, String> {
        let pairs: Vec<(String, String)> = self.settings.clone().into_iter().collect();
        Settings::layered(None, &pairs).map_err(|e| e.to_string())
    }
}

/// A batch as it was asked for, checked and with all defaults filled in.
#[derive(Clone, Debug, PartialEq)]
pub struct Manifest {
    /// What may be used.
    pub budget: Needs,
    /// A scene's process in which nothing has moved for so long, in seconds, is ended and tried again.
    pub patience_s: f64,
    /// The scenes, in the file's order.
    pub jobs: Vec<(SceneJob, Job)>,
}

impl Manifest {
    /// Reads a manifest. `folder` is the batch's: where scenes run that name no folder of their own.
    ///
    /// # Errors
    /// In words, and before anything was begun: what is wrong with the file or with one of its scenes.
    pub fn read(file: &Path, folder: &Path) -> Result<Self, ManifestError> {
        let text = std::fs::read_to_string(file)
            .map_err(|source| ManifestError::Read { file: file.to_path_buf(), source })?;
        let wrong = |reason: String| ManifestError::File { file: file.to_path_buf(), reason };
        let read: File = toml::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        if read.scene.is_empty() {
            return Err(wrong("it has no [[scene]]".into()));
        }
        let machine = machine::whole();
        let budget = Needs {
            cores: read.budget.cores.filter(|&n| n > 0).unwrap_or(machine.cores),
            memory_bytes: match &read.budget.memory {
                Some(size) => size.bytes().map_err(wrong)?,
                None => machine.memory_bytes / 5 * 4,
            },
            accelerators: read.budget.accelerators.unwrap_or(0),
        };
        let patience_s = read.budget.patience.unwrap_or(3600.0);
        if patience_s.is_nan() || patience_s <= 0.0 {
            return Err(wrong(format!("[budget] patience = {patience_s} makes no sense: say seconds")));
        }
        let share = (budget.cores / read.scene.len() as u32).max(1);
        let base = std::path::absolute(file).unwrap_or_else(|_| file.to_owned());
        let base = base.parent().unwrap_or(Path::new("."));
        let folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
        let mut jobs = Vec::new();
        let (mut names, mut outs) = (BTreeSet::new(), BTreeSet::new());
        for entry in &read.scene {
            let path = base.join(&entry.path);
            let name = entry.name.clone().unwrap_or_else(|| {
                path.file_name().map_or("scene".into(), |n| n.to_string_lossy().into_owned())
            });
            let wrong = |reason: String| ManifestError::Scene {
                file: file.to_path_buf(),
                scene: name.clone(),
                reason,
            };
            if name.is_empty()
                || name.chars().any(|c| c.is_control() || "/\\".contains(c))
                || name.starts_with('.')
            {
                return Err(wrong("its name must be usable as a file's name: set `name`".into()));
            }
            if !names.insert(name.clone()) {
                return Err(wrong("there are two scenes of this name: set `name`".into()));
            }
            let out = entry.out.as_ref().map_or_else(|| folder.join(&name), |out| base.join(out));
            if !outs.insert(out.clone()) {
                return Err(wrong(format!("two scenes run in {}: set `out`", out.display())));
            }
            let d = &read.defaults;
            let settings = settings(d, entry).map_err(wrong)?;
            let scene = SceneJob { name: name.clone(), path, out, settings };
            let effective = scene.effective().map_err(wrong)?;
            let memory = match entry.memory.as_ref().or(d.memory.as_ref()) {
                Some(size) => size.bytes().map_err(wrong)?,
                // An estimate is no reason to refuse a scene that the machine may well hold.
                None => estimate(&scene, &effective).min(budget.memory_bytes),
            };
            let needs = Needs {
                cores: entry.cores.or(d.cores).unwrap_or(share).max(1),
                memory_bytes: memory,
                accelerators: entry.accelerators.or(d.accelerators).unwrap_or(0),
            };
            if !needs.fit(&budget) {
                return Err(wrong(format!("it needs {}, the budget is {}", words(&needs), words(&budget))));
            }
            let job = Job {
                id: name.clone(),
                payload: serde_json::to_string(&scene).map_err(|e| wrong(e.to_string()))?,
                priority: entry.priority.or(d.priority).unwrap_or(0),
                needs,
                retry: Retry {
                    attempts: entry.attempts.or(d.attempts).unwrap_or(3).max(1),
                    ..Retry::default()
                },
            };
            jobs.push((scene, job));
        }
        Ok(Self { budget, patience_s, jobs })
    }
}

/// The settings of a scene: the defaults', then its own.
fn settings(defaults: &Terms, entry: &Entry) -> Result<BTreeMap<String, String>, String> {
    let mut all = BTreeMap::new();
    for (preset, table) in [(&defaults.preset, &defaults.settings), (&entry.preset, &entry.settings)] {
        if let Some(preset) = preset {
            all.insert("preset".to_owned(), preset.clone());
        }
        for (name, value) in table {
            let value = match value {
                toml::Value::String(text) => text.clone(),
                toml::Value::Table(_) | toml::Value::Array(_) => {
                    return Err(format!("the setting `{name}` must be a single value"));
                }
                other => other.to_string(),
            };
            all.insert(name.replace('-', "_"), value);
        }
    }
    // How many threads a scene has is the batch's to say.
    match all.remove("threads") {
        Some(_) => Err("`threads` is not set here: say `cores`".into()),
        None => Ok(all),
    }
}

/// Needs in words: `2 cores, 1.0 GiB`.
pub(crate) fn words(needs: &Needs) -> String {
    let plural = |n: u32, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
    let mut text = plural(needs.cores, "core");
    text += &format!(", {:.1} GiB", needs.memory_bytes as f64 / (1u64 << 30) as f64);
    if needs.accelerators > 0 {
        text += &format!(", {}", plural(needs.accelerators, "accelerator"));
    }
    text
}

/// Memory that a scene is taken to need when nobody says: photos are kept as bytes at three sizes, splats with
/// their gradients, moments and features. Fitted to runs of 40 photos, and
/// rounded up: such runs took 134 MiB at 320 px and 389 MiB at 640 px.
fn estimate(scene: &SceneJob, settings: &Settings) -> u64 {
    const BASE: u64 = 192 << 20;
    const BYTES_PER_PIXEL: u64 = 12;
    const BYTES_PER_SPLAT: u64 = 2048;
    let images = ["images", "dense/images", ""].map(|sub| scene.path.join(sub));
    let photos = images
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .map(|entries| entries.flatten().filter(|e| e.path().is_file()).count() as u64)
        .max()
        .unwrap_or(0);
    let side = u64::from(settings.scene.size).max(1);
    let splats = if settings.train.splats > 0 { settings.train.splats as u64 } else { 50_000 };
    BASE + photos * side * side * 3 / 4 * BYTES_PER_PIXEL + splats * BYTES_PER_SPLAT
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Manifest, String> {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("batch.toml");
        std::fs::write(&file, text).unwrap();
        Manifest::read(&file, &dir.path().join("out")).map_err(|e| e.to_string())
    }

    #[test]
    fn defaults_and_scenes_are_layered() {
        let manifest = read(
            "[budget]\ncores = 4\nmemory = \"8 GiB\"\n\
             [defaults]\npreset = \"draft\"\nattempts = 2\nsettings = { size = 320, steps = 100 }\n\
             [[scene]]\npath = \"a/liberty\"\npriority = 7\nsettings = { steps = 200, robust = false }\n\
             [[scene]]\npath = \"b\"\nname = \"second\"\nout = \"elsewhere\"\ncores = 3\nmemory = 1000000\npreset = \"best\"\n",
        )
        .unwrap();
        assert_eq!((manifest.budget.cores, manifest.budget.memory_bytes), (4, 8 << 30));
        let [(liberty, first), (second, other)] = &manifest.jobs[..] else { panic!("two scenes") };
        assert_eq!((liberty.name.as_str(), first.priority, first.retry.attempts), ("liberty", 7, 2));
        assert!(liberty.path.ends_with("a/liberty") && liberty.path.is_absolute());
        assert!(liberty.out.ends_with("out/liberty"));
        let effective = liberty.effective().unwrap();
        assert_eq!((effective.scene.size, effective.train.steps, effective.train.robust), (320, 200, false));
        assert_eq!(first.needs.cores, 2, "the budget's cores, shared evenly");
        assert!(first.needs.memory_bytes > 200 << 20, "estimated");
        assert!(second.out.ends_with("elsewhere"));
        assert_eq!((other.needs.cores, other.needs.memory_bytes), (3, 1_000_000));
        assert_eq!(second.settings["preset"], "best");
    }

    #[test]
    fn mistakes_are_named_before_anything_begins() {
        let scene = "[[scene]]\npath = \"a\"\n";
        for (text, said) in [
            ("", "no [[scene]]".to_owned()),
            ("[[scene]]\nname = \"x\"\n", "path".into()),
            ("[budgets]\n", "budgets".into()),
            (
                &format!("[defaults]\nsettings = {{ stpes = 3 }}\n{scene}"),
                "scene `a`: there is no setting named `stpes`".into(),
            ),
            (
                &format!("[defaults]\nsettings = {{ steps = \"many\" }}\n{scene}"),
                "`many` does not fit `steps`".into(),
            ),
            (&format!("[defaults]\nsettings = {{ threads = 2 }}\n{scene}"), "say `cores`".into()),
            (&format!("{scene}{scene}"), "two scenes of this name".into()),
            (&format!("[budget]\nmemory = \"lots\"\n{scene}"), "`lots` is no amount of memory".into()),
            (&format!("[budget]\ncores = 2\n{scene}cores = 3\n"), "it needs 3 cores".into()),
            (&format!("[budget]\npatience = 0\n{scene}"), "patience = 0 makes no sense".into()),
            ("[[scene]]\npath = \"a\"\nname = \"../x\"\n", "usable as a file's name".into()),
            (
                "[[scene]]\npath = \"a\"\nout = \"o\"\n[[scene]]\npath = \"b\"\nout = \"o\"\n",
                "two scenes run in".into(),
            ),
        ] {
            let message = read(text).unwrap_err();
            assert!(message.contains("batch.toml") && message.contains(&said), "{message}");
        }
    }

    #[test]
    fn amounts_of_memory_are_read() {
        for (text, bytes) in [("512 MiB", 512 << 20), ("1.5GiB", 3 << 29), ("2 GB", 2_000_000_000), ("7", 7)]
        {
            assert_eq!(read_size(text), Ok(bytes));
        }
    }
}
