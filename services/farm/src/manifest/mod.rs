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
//! settings = { size = 320 }    # any setting of docs/reference/settings.md
//!
//! [[scene]]
//! path = "photos/liberty"      # relative to this file
//! name = "liberty"             # default: the folder's name
//! out = "runs/liberty"         # default: NAME in the batch folder
//! priority = 5                 # higher goes first
//! cores = 2                    # default: the budget's, shared evenly
//! memory = "1 GiB"             # its `--memory-budget`; default: the budget's, shared as the cores are
//! accelerators = 0             # that it has for itself as long as it runs
//! # accelerator = "h100"       # which one, by the name that a farm's workers give theirs
//! # until = "geometry"         # where it stops: a stage, or a step of the training
//! settings = { steps = 4000 }
//! ```

mod error;
mod file;
mod run_folders;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use segwild_flow::files::name;
use segwild_pipeline::{MemoryNeed, Settings, SettingsError, Until};
use serde::{Deserialize, Serialize};

pub use self::error::{ManifestError, ManifestFileError, MemorySizeError, SceneEntryError};
use self::file::{File, settings};
pub use self::run_folders::FolderTaken;
use self::run_folders::RunFolders;
use crate::job::{Job, Needs, Retry};
use crate::machine;

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
    /// Where it stops, as `--until` takes it; `None`: at the end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until: Option<String>,
}

impl SceneJob {
    /// Its effective settings.
    ///
    /// # Errors
    /// A name or a value does not fit.
    pub fn effective(&self) -> Result<Settings, SettingsError> {
        let pairs: Vec<(String, String)> = self.settings.clone().into_iter().collect();
        Settings::layered(None, &pairs)
    }
}

/// A batch as it was requested, checked and with all defaults filled in.
#[derive(Clone, Debug, PartialEq)]
pub struct BatchManifest {
    /// What may be used.
    pub budget: Needs,
    /// A scene's process in which nothing has moved for so long, in seconds, is ended and tried again.
    pub patience_s: f64,
    /// The scenes, in the file's order.
    pub jobs: Vec<(SceneJob, Job)>,
}

impl BatchManifest {
    /// Reads a manifest. `folder` is the batch's: where scenes run that name no folder of their own. `until` is where
    /// every scene stops, whatever the manifest says.
    ///
    /// # Errors
    /// Before anything was started: what is wrong with the file or with one of its scenes.
    pub fn read(file: &Path, folder: &Path, until: Option<Until>) -> Result<Self, ManifestError> {
        let whole = machine::whole();
        let usual = Needs { memory_bytes: whole.memory_bytes / 5 * 4, ..whole };
        Self::read_within(file, folder, until, usual, true)
    }

    /// Reads a manifest for a farm, whose workers have budgets of their own. A scene without `cores` takes one, so that a worker
    /// has as many scenes as cores, and one without `memory` as much as it makes use of: 1 GiB where it cannot be opened yet, since
    /// its photos have no poses or cannot be read.
    ///
    /// # Errors
    /// As [`BatchManifest::read`].
    pub fn read_for_farm(file: &Path, until: Option<Until>) -> Result<Self, ManifestError> {
        let unlimited = Needs { cores: 1, memory_bytes: u64::MAX >> 1, accelerators: u32::MAX };
        Self::read_within(file, Path::new("runs"), until, unlimited, false)
    }

    /// Reads a manifest; what it does not say of the budget is `usual`.
    fn read_within(
        file: &Path,
        folder: &Path,
        until: Option<Until>,
        usual: Needs,
        bounded: bool,
    ) -> Result<Self, ManifestError> {
        let wrong = |reason: ManifestFileError| ManifestError::File { file: file.to_path_buf(), reason };
        let bytes =
            std::fs::read(file).map_err(|source| ManifestError::Read { file: file.to_path_buf(), source })?;
        let text = segwild_scene::text::decode(bytes).map_err(|e| wrong(e.into()))?;
        let read: File = toml::from_str(&text).map_err(|e| wrong(e.into()))?;
        if read.scene.is_empty() {
            return Err(wrong(ManifestFileError::NoScene));
        }
        let budget = Needs {
            cores: read.budget.cores.filter(|&n| n > 0).unwrap_or(usual.cores),
            memory_bytes: match &read.budget.memory {
                Some(size) => size.bytes().map_err(|e| wrong(e.into()))?,
                None => usual.memory_bytes,
            },
            accelerators: read.budget.accelerators.unwrap_or(usual.accelerators),
        };
        let patience_s = read.budget.patience.unwrap_or(3600.0);
        if patience_s.is_nan() || patience_s <= 0.0 {
            return Err(wrong(ManifestFileError::Patience(patience_s)));
        }
        let share = (budget.cores / read.scene.len() as u32).max(1);
        // On a farm there is no budget to have a share of.
        let unopened = if bounded { u64::MAX } else { UNOPENED_BYTES };
        let base = std::path::absolute(file).unwrap_or_else(|_| file.to_owned());
        let base = base.parent().unwrap_or(Path::new("."));
        let folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
        let mut jobs = Vec::new();
        let (mut names, mut outs) = (BTreeSet::new(), RunFolders::default());
        for entry in &read.scene {
            let path = base.join(&entry.path);
            let name = entry.name.clone().unwrap_or_else(|| {
                path.file_name().map_or("scene".into(), |n| n.to_string_lossy().into_owned())
            });
            let wrong = |reason: SceneEntryError| ManifestError::Scene {
                file: file.to_path_buf(),
                scene: name.clone(),
                reason: Box::new(reason),
            };
            if let Err(why) = usable(&name) {
                return Err(wrong(SceneEntryError::Name(why)));
            }
            // Capitals make no other file on some systems, and names become files.
            if !names.insert(name.to_lowercase()) {
                return Err(wrong(SceneEntryError::SameName));
            }
            let out = entry.out.as_ref().map_or_else(|| folder.join(&name), |out| base.join(out));
            outs.take(&name, &out).map_err(|e| wrong(e.into()))?;
            if let Some(key) = entry.unknown.keys().next() {
                return Err(wrong(SceneEntryError::UnknownKey(key.clone())));
            }
            let (d, own) = (&read.defaults, &entry.terms);
            let settings = settings(d, own).map_err(wrong)?;
            let stop = own.until.as_ref().or(d.until.as_ref()).map(|s| s.read()).transpose();
            let until = until.or(stop.map_err(wrong)?).map(|until| match until {
                Until::Stage(stage) => stage.to_string(),
                Until::Step(step) => step.to_string(),
            });
            let scene = SceneJob { name: name.clone(), path, out, settings, until };
            let effective = scene.effective().map_err(|e| wrong(e.into()))?;
            let cores = own.cores.or(d.cores).unwrap_or(share).max(1);
            let declared = own.memory.as_ref().or(d.memory.as_ref());
            let declared = declared.map(|size| size.bytes()).transpose().map_err(|e| wrong(e.into()))?;
            let needs = Needs {
                cores,
                memory_bytes: memory(&scene, &effective, declared, cores, &budget, unopened)
                    .map_err(wrong)?,
                accelerators: own.accelerators.or(d.accelerators).unwrap_or(0),
            };
            if bounded && !needs.fit(&budget) {
                return Err(wrong(SceneEntryError::OverBudget { needs, budget }));
            }
            let job = Job {
                id: name.clone(),
                payload: serde_json::to_string(&scene).map_err(|e| wrong(e.into()))?,
                priority: own.priority.or(d.priority).unwrap_or(0),
                needs,
                retry: Retry {
                    attempts: own.attempts.or(d.attempts).unwrap_or(3).max(1),
                    ..Retry::default()
                },
                accelerator: own.accelerator.clone().or_else(|| d.accelerator.clone()),
            };
            jobs.push((scene, job));
        }
        Ok(Self { budget, patience_s, jobs })
    }
}

/// Names that the batch folder needs for itself.
const KEPT: [&str; 5] = ["logs", "settings", "batch.json", "batch.lock", "batch.sqlite"];

/// Whether a scene's name can be that of its files in the batch folder; else why not.
fn usable(name: &str) -> Result<(), &'static str> {
    match KEPT.contains(&name.to_lowercase().as_str()) {
        true => Err("the batch keeps this one for itself"),
        false => name::usable(name),
    }
}

/// Memory in bytes that a farm sets aside for a scene that cannot be opened when it is handed in. Every worker should have as much:
/// a scene whose photos cannot be read ends at once, with the reason.
const UNOPENED_BYTES: u64 = 1 << 30;

/// The memory of a scene: what was declared, or its share of the budget, as far as it makes use of it. One that cannot be opened
/// gets `unopened` bytes of its share at most. Refused when it could not run with that.
fn memory(
    scene: &SceneJob,
    settings: &Settings,
    declared: Option<u64>,
    cores: u32,
    budget: &Needs,
    unopened: u64,
) -> Result<u64, SceneEntryError> {
    let share = budget.memory_bytes / u64::from(budget.cores.max(1)) * u64::from(cores.min(budget.cores));
    let (whose, given) = match declared {
        Some(bytes) if bytes <= budget.memory_bytes => ("its `memory`", bytes),
        _ => ("the budget", budget.memory_bytes),
    };
    let given_mib = u32::try_from(given >> 20).unwrap_or(u32::MAX);
    // Why a scene cannot be opened is for its own process to say: the others go on.
    let Ok(need) = MemoryNeed::within(given_mib, &scene.path, settings) else {
        return Ok(declared.unwrap_or(share.min(unopened)));
    };
    let (least, most) = (u64::from(need.least_mib) << 20, u64::from(need.most_mib) << 20);
    if given < least {
        return Err(SceneEntryError::Memory { need: need.to_string(), whose, given_mib: given >> 20 });
    }
    Ok(declared.unwrap_or(share.min(most).max(least)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<BatchManifest, ManifestError> {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("batch.toml");
        std::fs::write(&file, text).unwrap();
        BatchManifest::read(&file, &dir.path().join("out"), None)
    }

    #[test]
    fn defaults_and_scenes_are_layered() {
        let manifest = read(
            "[budget]\ncores = 4\nmemory = \"8 GiB\"\n\
             [defaults]\npreset = \"draft\"\nattempts = 2\nuntil = \"geometry\"\nsettings = { size = 320, steps = 100 }\n\
             [[scene]]\npath = \"a/liberty\"\npriority = 7\nsettings = { steps = 200, robust = false }\n\
             [[scene]]\npath = \"b\"\nname = \"second\"\nout = \"elsewhere\"\ncores = 3\nmemory = 1000000\nuntil = 500\npreset = \"best\"\n",
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
        assert_eq!(first.needs.memory_bytes, 4 << 30, "the budget's memory, in proportion to the cores");
        assert_eq!((liberty.until.as_deref(), second.until.as_deref()), (Some("geometry"), Some("500")));
        assert!(second.out.ends_with("elsewhere"));
        assert_eq!((other.needs.cores, other.needs.memory_bytes), (3, 1_000_000));
        assert_eq!(second.settings["preset"], "best");
    }

    #[test]
    fn a_farm_runs_a_scene_that_cannot_be_opened_yet() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("empty")).unwrap();
        std::fs::create_dir(dir.path().join("text")).unwrap();
        std::fs::write(dir.path().join("text/a.jpg"), "no photo").unwrap();
        let file = dir.path().join("batch.toml");
        let scenes = "[[scene]]\npath = \"empty\"\n[[scene]]\npath = \"text\"\n\
                      [[scene]]\npath = \"text\"\nname = \"declared\"\nmemory = \"3 GiB\"\n";
        for head in ["", "[budget]\ncores = 2\n"] {
            std::fs::write(&file, format!("{head}{scenes}")).unwrap();
            let manifest = BatchManifest::read_for_farm(&file, None).unwrap();
            let bytes: Vec<u64> = manifest.jobs.iter().map(|(_, job)| job.needs.memory_bytes).collect();
            assert_eq!(bytes, [UNOPENED_BYTES, UNOPENED_BYTES, 3 << 30], "{head}");
        }
    }

    #[test]
    fn a_manifest_that_a_windows_editor_saved_is_read() {
        let manifest = read("\u{feff}[[scene]]\r\npath = \"a\"\r\n").unwrap();
        assert_eq!(manifest.jobs[0].0.name, "a");
    }

    #[test]
    fn mistakes_are_named_before_anything_starts() {
        let scene = "[[scene]]\npath = \"a\"\n";
        for (text, expected) in [
            ("", "no [[scene]]".to_owned()),
            ("[[scene]]\nname = \"x\"\n", "path".into()),
            ("[budgets]\n", "budgets".into()),
            (&format!("{scene}memroy = 3\n"), "scene `a`: there is no key named `memroy`".into()),
            (&format!("[defaults]\nmemroy = 3\n{scene}"), "memroy".into()),
            (
                &format!("[defaults]\nsettings = {{ stpes = 3 }}\n{scene}"),
                "scene `a`: there is no setting named `stpes`".into(),
            ),
            (
                &format!("[defaults]\nsettings = {{ steps = \"many\" }}\n{scene}"),
                "`many` does not fit `steps`".into(),
            ),
            (&format!("[defaults]\nsettings = {{ threads = 2 }}\n{scene}"), "say `cores`".into()),
            (&format!("{scene}settings = {{ memory_budget = 2 }}\n"), "say `memory`".into()),
            (&format!("{scene}until = \"geometri\"\n"), "`until = geometri`: neither a stage".into()),
            (&format!("{scene}until = 0\n"), "there is no step 0".into()),
            (&format!("{scene}{scene}"), "two scenes of this name".into()),
            (&format!("[budget]\nmemory = \"lots\"\n{scene}"), "`lots` is no amount of memory".into()),
            (&format!("[budget]\ncores = 2\n{scene}cores = 3\n"), "it needs 3 cores".into()),
            (&format!("[budget]\npatience = 0\n{scene}"), "patience = 0 makes no sense".into()),
            ("[[scene]]\npath = \"a\"\nname = \"../x\"\n", "usable as a file's name".into()),
            (
                "[[scene]]\npath = \"a\"\nout = \"o\"\n[[scene]]\npath = \"b\"\nout = \"o\"\n",
                "two scenes run in".into(),
            ),
            ("[[scene]]\npath = \"a\"\nname = \"logs\"\n", "the batch keeps".into()),
            (&format!("[[scene]]\npath = \"a\"\nname = \"{}\"\n", "n".repeat(101)), "longer than 100".into()),
            ("[[scene]]\npath = \"a\"\n[[scene]]\npath = \"b/A\"\n", "two scenes of this name".into()),
        ] {
            let message = read(text).unwrap_err().to_string();
            assert!(message.contains("batch.toml") && message.contains(&expected), "{message}");
        }
    }
}
