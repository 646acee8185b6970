//! The folder of a run.
//!
//! ```text
//! RUN/segwild.toml      the effective settings
//! RUN/scene.json        where the scene is, its photos, those skipped and why
//! RUN/cameras.json      the photos' cameras in the space of scene.ply
//! RUN/run.sqlite        the ledger
//! RUN/cache/            artefacts by the hash of what they were made from
//! RUN/poses/            the poses of photos that came without, and COLMAP's database, log and models
//! RUN/views/            the views of imported splats that came without photos
//! RUN/checkpoints/      from which an interrupted training continues
//! RUN/model.bin         the trained scene; RUN/scene.ply the same for other programs
//! RUN/features.bin      the feature field
//! RUN/history.jsonl     loss, PSNR and splats over the steps
//! RUN/timeline.json     who did what when; RUN/trace.json the same for Perfetto, RUN/trace.otlp.json for OpenTelemetry
//! RUN/appearance_choice.json  the chosen appearance model; RUN/budget.json the chosen steps
//! RUN/time.json         what a time bought, and what was measured of the machine
//! RUN/blocks.json       in how many blocks the scene is trained, where the memory budget decides
//! RUN/networks.json     the network files it was made with, and their hashes
//! RUN/evaluation.json   held-out scores
//! RUN/transients/PHOTO.png  the transient mask of a photo; the next run uses it as a person has changed it
//! RUN/objects/          the list of the scene's objects, with thumbnails
//! RUN/selections/NAME/  what `segment` made
//! RUN/report.html       all of the above on one page
//! ```

use crate::artifacts::images::ImageFiles;
use crate::{RunError, Settings};
use segwild_features::{FeatureError, FeatureField, WideFeatureField};
use segwild_flow::codec::{CodecError, StreamedRecord};
use segwild_flow::files::Stray;
use segwild_flow::ledger::{CheckpointRow, State};
use segwild_flow::{Cache, FileError, Ledger, codec, files};
use segwild_poses::PosesFolder;
use segwild_scene::{Scene, SceneFrame, SceneSettings, Skipped};
use segwild_segmenter::SelectionConfidence;
use segwild_trainer::{Checkpoint, Model};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashSet};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Kind of the record in `model.bin`, and of models in the cache.
pub(crate) const MODEL: &str = "model";
/// Kind of the record in `features.bin`, and of fields in the cache.
pub(crate) const FEATURES: &str = "features/2";
/// Kind of the record in `features.bin` of earlier versions, whose numbers have 32 bits.
const WIDE_FEATURES: &str = "features";
/// Kind of the records of checkpoints.
pub(crate) const CHECKPOINT: &str = "checkpoint";
/// The folder of the timelines of earlier processes and of selections.
pub(crate) const EARLIER: &str = "traces";

/// Letters that a message shows of a requested name that does not exist.
const LONGEST_ECHO: usize = 120;

/// Folders and files that are written into, beside the ledger (`run.sqlite`, its log and its lock).
const WRITTEN_INTO: [&str; 11] = [
    "cache",
    "checkpoints",
    "history.jsonl",
    "objects",
    "poses",
    "renders",
    "selections",
    "studio",
    "transients",
    "views",
    EARLIER,
];

/// Files that are read and lie in no folder that is written into.
const READ: [&str; 8] = [
    "evaluation.json",
    "features.bin",
    "model.bin",
    "networks.json",
    "report.html",
    "scene.json",
    "segwild.toml",
    "timeline.json",
];

/// A run's folder.
#[derive(Clone, Debug)]
pub struct RunFolder {
    path: PathBuf,
}

/// `scene.json`: the inputs of the run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Intake {
    /// The scene, as an absolute path; in the file, one within the run folder is relative to it, so that both move together.
    pub scene: PathBuf,
    /// Whether the run computed the poses of its photos.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub posed: bool,
    /// The photos that take part, in order.
    pub photos: Vec<String>,
    /// Those held out.
    pub held_out: Vec<String>,
    /// Those that cannot be used, and why.
    pub skipped: Vec<Skipped>,
    /// Reconstructed points.
    pub points: usize,
    /// The transform back to the scene's units.
    pub frame: SceneFrame,
    /// The provider of the masks ([`segwild_vision::Providers::name`]); empty in folders of versions that did not
    /// record it.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub provider: String,
    /// Photos that are trained on, and of which neither masks nor descriptors are made (method, section 9).
    #[serde(default)]
    pub undescribed: usize,
}

/// A scene in the middle of its training.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrainingSnapshot {
    /// Steps done.
    pub step: u32,
    /// The checkpoint's file.
    file: String,
}

/// A finished run, read back.
pub struct Loaded {
    /// Its settings.
    pub settings: Settings,
    /// Its scene.
    pub scene: Scene,
    /// The trained scene.
    pub model: Model,
    /// The feature field, if that stage was done.
    pub field: Option<FeatureField>,
}

impl RunFolder {
    /// The folder at `path`, made if it is not there.
    pub fn create(path: &Path) -> Result<RunFolder, RunError> {
        let folder = RunFolder { path: path.to_owned() };
        folder.stays_inside()?;
        for dir in [folder.path.clone(), folder.checkpoints(), folder.path.join("selections")] {
            std::fs::create_dir_all(&dir)
                .map_err(|e| files::FileError::new("create the run folder", &dir, e))?;
        }
        Ok(folder)
    }

    /// The folder at `path`, there or not; nothing is made.
    pub fn at(path: &Path) -> RunFolder {
        RunFolder { path: path.to_owned() }
    }

    /// An existing run.
    pub fn open(path: &Path) -> Result<RunFolder, RunError> {
        let folder = RunFolder { path: path.to_owned() };
        if !folder.ledger().is_file() {
            let reason = "this is no run folder; `segwild run SCENE --out FOLDER` makes one".into();
            return Err(RunError::Folder { path: path.to_owned(), reason });
        }
        folder.stays_inside()?;
        Ok(folder)
    }

    /// Refuses a folder in which something would be written through a link to elsewhere. Files that are written as a
    /// whole replace a link; these are written into.
    pub(crate) fn stays_inside(&self) -> Result<(), RunError> {
        let ours = |name: &str| WRITTEN_INTO.contains(&name) || name.starts_with("run.");
        let stray = |Stray { path, reason }| RunError::Folder { path, reason };
        files::stays_inside(&self.path, ours).map_err(stray)?;
        READ.iter().try_for_each(|name| self.refuse_device(name))
    }

    /// Refuses a pipe or a device instead of a file: reading it would wait for ever, or never end.
    fn refuse_device(&self, name: &str) -> Result<(), RunError> {
        match std::fs::metadata(self.path.join(name)).map(|data| data.file_type()) {
            Ok(kind) if !kind.is_file() && !kind.is_dir() => {
                Err(self.broken(name, "it is a pipe, a device or a socket, not a file: remove it".into()))
            }
            _ => Ok(()),
        }
    }

    /// The file of a checkpoint that the ledger knows; `None` where it names anything but a file among the checkpoints.
    pub(crate) fn checkpoint(&self, row: &CheckpointRow) -> Option<PathBuf> {
        files::name::is_plain(&row.file).then(|| self.checkpoints().join(&row.file))
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The ledger's file.
    pub fn ledger(&self) -> PathBuf {
        self.path.join("run.sqlite")
    }

    /// The settings' file.
    pub fn settings_file(&self) -> PathBuf {
        self.path.join("segwild.toml")
    }

    /// The folder of one selection.
    pub fn selection(&self, name: &str) -> PathBuf {
        self.path.join("selections").join(name)
    }

    /// Names of the selections made so far, sorted.
    pub fn selections(&self) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(self.path.join("selections"))
            .into_iter()
            .flatten()
            .flatten()
            .filter(|e| e.path().join("prompts.json").is_file())
            .map(|e| e.file_name().to_string_lossy().into_owned())
            // Left out: a selection that is still being written or whose process was killed, and names that this
            // program does not write.
            .filter(|name| files::name::usable(name).is_ok())
            .collect();
        names.sort();
        names
    }

    /// Refuses a selection that was never made, and names those that were.
    pub(crate) fn has_selection(&self, name: &str) -> Result<(), RunError> {
        let known = self.selections();
        if known.iter().any(|k| k == name) {
            return Ok(());
        }
        let known = if known.is_empty() { "there is none yet".to_owned() } else { known.join(", ") };
        let requested: String = name.chars().take(LONGEST_ECHO).collect();
        let (requested, known) = (files::name::one_line(&requested), files::name::one_line(&known));
        Err(RunError::Request(format!("this run has no selection named `{requested}` ({known})")))
    }

    /// File of each photo's mask in a selection's `masks` and `amodal`, as they are written now.
    pub fn mask_files(&self) -> Result<BTreeMap<String, String>, RunError> {
        let photos = self.intake()?.photos;
        let files = ImageFiles::of(photos.iter().map(String::as_str)).names().to_vec();
        Ok(photos.into_iter().zip(files).collect())
    }

    /// Seconds from the prompts of a selection to its splats, where that was recorded.
    pub fn answered_in(&self, selection: &str) -> Option<f64> {
        let summary: serde_json::Value =
            self.read_json(&format!("selections/{selection}/summary.json")).ok()?;
        summary.get("select_s")?.as_f64()
    }

    /// The provider of a selection's masks, where that was recorded.
    pub fn provider_of(&self, selection: &str) -> Option<String> {
        let summary: serde_json::Value =
            self.read_json(&format!("selections/{selection}/summary.json")).ok()?;
        Some(summary.get("provider")?.as_str()?.to_owned())
    }

    /// How sure a selection is, where that was recorded.
    pub fn confidence_of(&self, selection: &str) -> Option<SelectionConfidence> {
        let mut summary: serde_json::Value =
            self.read_json(&format!("selections/{selection}/summary.json")).ok()?;
        serde_json::from_value(summary.get_mut("confidence")?.take()).ok()
    }

    /// The report's file.
    pub fn report(&self) -> PathBuf {
        self.path.join("report.html")
    }

    /// Where the poses of photos are computed that come without.
    pub(crate) fn poses(&self) -> PosesFolder {
        PosesFolder::at(self.path.join("poses"))
    }

    /// Opens the photos at `path` with the poses that this run computed.
    ///
    /// # Errors
    /// When there are none, or the photos are gone.
    pub(crate) fn open_posed(&self, path: &Path, settings: &SceneSettings) -> Result<Scene, RunError> {
        let missing = || self.broken("poses", "it holds no poses yet; `segwild run` computes them".into());
        let posed = self.poses().posed(path, settings)?.ok_or_else(missing)?;
        Ok(Scene::open_posed(posed, settings)?)
    }

    pub(crate) fn checkpoints(&self) -> PathBuf {
        self.path.join("checkpoints")
    }

    pub(crate) fn history(&self) -> PathBuf {
        self.path.join("history.jsonl")
    }

    pub(crate) fn cache(&self) -> Result<Cache, RunError> {
        Ok(Cache::open(self.path.join("cache"))?)
    }

    /// Removes what killed processes left half-written.
    pub(crate) fn remove_litter(&self) {
        for folder in ["", "checkpoints", "cache/tmp", "selections"] {
            files::remove_litter(&self.path.join(folder));
        }
    }

    pub(crate) fn write(&self, name: &str, bytes: &[u8]) -> Result<(), RunError> {
        Ok(files::write_atomic(&self.path.join(name), bytes)?)
    }

    pub(crate) fn write_json<T: Serialize>(&self, name: &str, value: &T) -> Result<(), RunError> {
        let text = serde_json::to_vec_pretty(value).map_err(|e| self.broken(name, e.to_string()))?;
        self.write(name, &text)
    }

    pub(crate) fn read_json<T: for<'de> Deserialize<'de>>(&self, name: &str) -> Result<T, RunError> {
        let bytes = files::read_plain(&self.path.join(name)).map_err(|e| self.broken(name, e.to_string()))?;
        serde_json::from_slice(&bytes).map_err(|e| self.broken(name, e.to_string()))
    }

    fn broken(&self, name: &str, reason: String) -> RunError {
        RunError::Folder { path: self.path.join(name), reason }
    }

    pub(crate) fn write_record<T: codec::Encode + ?Sized>(
        &self,
        name: &str,
        kind: &str,
        value: &T,
    ) -> Result<(), RunError> {
        let path = self.path.join(name);
        let record = StreamedRecord::of(kind, value)
            .map_err(|source| RunError::Record { path: path.clone(), source })?;
        record.write_file(&path)?;
        Ok(())
    }

    pub(crate) fn read_record<T: codec::Decode>(&self, name: &str, kind: &str) -> Result<T, RunError> {
        let path = self.path.join(name);
        let bytes = codec::read_file(&path).map_err(|error| match error.kind() {
            ErrorKind::NotFound => {
                let reason =
                    "this part of the run is not done yet; `segwild run` with the same folder continues it";
                RunError::Folder { path: path.clone(), reason: reason.into() }
            }
            _ => FileError::new("read", &path, error).into(),
        })?;
        codec::decode(kind, &bytes).map_err(|source| RunError::Record { path, source })
    }

    /// Reads `model.bin` and `features.bin`, as far as they are there, and compares their hashes: how many there are, and those that
    /// are damaged, each with the reason.
    pub fn verify_records(&self) -> (usize, Vec<(PathBuf, String)>) {
        let (mut count, mut damaged) = (0, Vec::new());
        for name in ["model.bin", "features.bin"] {
            let path = self.path.join(name);
            let reason = match codec::read_file(&path) {
                Err(error) if error.kind() == ErrorKind::NotFound => continue,
                Err(error) => Some(error.to_string()),
                Ok(bytes) => codec::open(&bytes).err().map(|error| error.to_string()),
            };
            count += 1;
            damaged.extend(reason.map(|reason| (path, reason)));
        }
        (count, damaged)
    }

    /// The settings that the run was made with, except paths of code ([`crate::Code`]).
    pub fn settings(&self) -> Result<Settings, RunError> {
        Ok(Settings::recorded(&self.settings_file(), &[])?)
    }

    pub(crate) fn intake(&self) -> Result<Intake, RunError> {
        let again = |error: RunError| match error {
            RunError::Folder { path, reason } => {
                let run = self.path.display();
                let reason = format!("{reason}; `segwild run SCENE --out {run}` writes it again");
                RunError::Folder { path, reason }
            }
            other => other,
        };
        let mut intake: Intake = self.read_json("scene.json").map_err(again)?;
        if intake.scene.is_relative() {
            let within = self.path.join(&intake.scene);
            intake.scene = std::path::absolute(&within).unwrap_or(within);
        }
        Ok(intake)
    }

    /// Writes the inputs of the run.
    pub(crate) fn write_intake(&self, intake: &Intake) -> Result<(), RunError> {
        let whole = std::path::absolute(&self.path).unwrap_or_else(|_| self.path.clone());
        let scene = intake.scene.strip_prefix(&whole).unwrap_or(&intake.scene).to_owned();
        self.write_json("scene.json", &Intake { scene, ..intake.clone() })
    }

    /// The scene that the run is of.
    ///
    /// # Errors
    /// When the run has not started, or its record is damaged.
    pub fn scene_path(&self) -> Result<PathBuf, RunError> {
        Ok(self.intake()?.scene)
    }

    /// Key of the training that the run's scene is of; `None` where no ledger names it, or another training is under way.
    pub fn training_key(&self) -> Option<String> {
        let stages = Ledger::open_read_only(self.ledger()).and_then(|ledger| ledger.stages()).ok()?;
        stages
            .into_iter()
            .find(|stage| stage.name == "geometry" && stage.state == State::Done)
            .map(|stage| stage.key)
    }

    /// Refuses a scene that is not the one of this run: the run's selections and corrected masks would be taken for
    /// those of the other scene. The same scene may have moved, and its photos may have changed.
    ///
    /// # Errors
    /// Names both scenes, and says what to do.
    pub(crate) fn belongs_to(&self, path: &Path, scene: &Scene) -> Result<(), RunError> {
        let Ok(known) = self.intake() else { return Ok(()) };
        let same =
            |a: &Path, b: &Path| matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b);
        if known.scene == path || same(&known.scene, path) {
            return Ok(());
        }
        let before: HashSet<&str> = known.photos.iter().map(String::as_str).collect();
        let kept = scene.views.iter().filter(|view| before.contains(view.name.as_str())).count();
        let frame = known.frame;
        let moved = (scene.frame.scale / frame.scale - 1.0).abs() < 0.01
            && scene.frame.origin.distance(frame.origin) < 0.01 * frame.scale;
        if 2 * kept >= before.len().max(scene.views.len()) && moved {
            return Ok(());
        }
        Err(RunError::Request(format!(
            "{} is the run of another scene, {}: of the {} photos of {} it knows {kept}, with other camera poses; give `--out` another folder, or \
             remove this one",
            self.path.display(),
            known.scene.display(),
            scene.views.len(),
            path.display()
        )))
    }

    /// Refuses a name that cannot be a selection's or an object's: it names a folder and files.
    ///
    /// # Errors
    /// When the name cannot be used.
    pub fn can_name(name: &str) -> Result<(), RunError> {
        let odd = |c: char| !(c.is_ascii_alphanumeric() || "-_.".contains(c));
        let wrong = match files::name::usable(name) {
            Err(why) => why,
            Ok(()) if name.contains(odd) => "it has other signs",
            Ok(()) => return Ok(()),
        };
        // The name may be of any length.
        let start: String = name.chars().take(60).collect();
        let more = if start.len() < name.len() { ".." } else { "" };
        let start = files::name::one_line(&start);
        Err(RunError::Request(format!(
            "`{start}{more}` cannot name a selection, for {wrong}: use letters, digits, dashes and underscores"
        )))
    }

    /// Reads a trained run back; the feature field may be missing.
    pub fn load(&self) -> Result<Loaded, RunError> {
        let settings = self.settings()?;
        let model: Model = self.read_record("model.bin", MODEL)?;
        model.check().map_err(|e| self.broken("model.bin", format!("{e}; `segwild run` writes it again")))?;
        let scene = self.scene_of(&settings, &model)?;
        let field = self.field()?.filter(|f| f.len() == model.splats.len());
        Ok(Loaded { settings, scene, model, field })
    }

    /// The feature field, if that stage was done. One of an earlier version is rounded as the field of a run is.
    fn field(&self) -> Result<Option<FeatureField>, RunError> {
        const NAME: &str = "features.bin";
        if !self.path.join(NAME).is_file() {
            return Ok(None);
        }
        let again = |e: FeatureError| self.broken(NAME, format!("{e}; `segwild run` writes it again"));
        let field = match self.read_record::<FeatureField>(NAME, FEATURES) {
            Err(RunError::Record { source: CodecError::Kind { found, .. }, .. })
                if found == WIDE_FEATURES =>
            {
                let wide: WideFeatureField = self.read_record(NAME, WIDE_FEATURES)?;
                FeatureField::try_from(wide).map_err(again)?
            }
            Err(RunError::Record { source: CodecError::Kind { found, .. }, .. })
                if found.starts_with("features/") =>
            {
                return Err(self.broken(
                    NAME,
                    format!(
                        "it is a feature field of the format `{found}`, and this program reads `{WIDE_FEATURES}` and `{FEATURES}`: use \
                         the version that wrote it, or delete the file and run again"
                    ),
                ));
            }
            read => read?,
        };
        field.check().map_err(again)?;
        Ok(Some(field))
    }

    /// The photos and cameras of a run, trained or not.
    ///
    /// # Errors
    /// When the run has not read them yet, or they are gone.
    pub fn scene(&self) -> Result<Scene, RunError> {
        self.scene_with(&self.settings()?, &self.intake()?)
    }

    fn scene_with(&self, settings: &Settings, intake: &Intake) -> Result<Scene, RunError> {
        // The model has imported splats already: their file may be gone.
        let settings = SceneSettings { imported_splats: String::new(), ..settings.scene.clone() };
        let opened = match intake.posed {
            true => self.open_posed(&intake.scene, &settings),
            false => Scene::open(&intake.scene, &settings).map_err(RunError::from),
        };
        match std::fs::metadata(&intake.scene) {
            Err(gone) if gone.kind() == ErrorKind::NotFound => opened.map_err(|_| {
                RunError::Input(format!(
                    "{}: the photos of this run are not there: put them back, or run `segwild run NEWPATH --out {}` if they \
                     have moved",
                    intake.scene.display(),
                    self.path.display()
                ))
            }),
            _ => opened,
        }
    }

    /// The run's scene as a model was trained, if it is that of the model.
    fn scene_of(&self, settings: &Settings, model: &Model) -> Result<Scene, RunError> {
        let intake = self.intake()?;
        let scene = self.scene_with(settings, &intake)?;
        if scene.views.iter().map(|v| &v.name).ne(&model.names) {
            let reason = format!(
                "the photos of {} have changed since this run: run again to bring it up to date",
                intake.scene.display()
            );
            return Err(RunError::Folder { path: self.path.clone(), reason });
        }
        Ok(Arc::unwrap_or_clone(model.posed(&Arc::new(scene))))
    }

    /// The newest checkpoint of a training, as a file and its step; `None` where there is none.
    pub fn newest_snapshot(&self) -> Option<TrainingSnapshot> {
        let entries = std::fs::read_dir(self.checkpoints()).ok()?.flatten();
        let newest = entries
            .filter_map(|entry| {
                let name = entry.file_name().into_string().ok()?;
                let step = name.strip_prefix("geometry-")?.strip_suffix(".bin")?.rsplit('-').next()?;
                Some((entry.metadata().ok()?.modified().ok()?, step.parse().ok()?, name))
            })
            .max()?;
        Some(TrainingSnapshot { step: newest.1, file: newest.2 })
    }

    /// Reads a run that is still trained, as it was at a snapshot.
    ///
    /// # Errors
    /// When the snapshot is gone or damaged.
    pub fn load_snapshot(&self, snapshot: &TrainingSnapshot) -> Result<Loaded, RunError> {
        let settings = self.settings()?;
        let file = format!("checkpoints/{}", snapshot.file);
        let checkpoint: Checkpoint = self.read_record(&file, CHECKPOINT)?;
        let broken = |e: String| self.broken(&file, e);
        let model = checkpoint.model().map_err(|e| broken(e.to_string()))?;
        model.check().map_err(|e| broken(e.to_string()))?;
        let scene = self.scene_of(&settings, &model)?;
        Ok(Loaded { settings, scene, model, field: None })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_features::{FeatureDecoder, Pca};

    fn run() -> (tempfile::TempDir, RunFolder) {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(dir.path()).unwrap();
        std::fs::write(folder.ledger(), "").unwrap();
        (dir, folder)
    }

    fn read(folder: &RunFolder) -> String {
        folder.read_record::<Model>("model.bin", MODEL).map(drop).unwrap_err().to_string()
    }

    #[test]
    fn only_a_missing_record_is_reported_as_not_done_yet() {
        let (_dir, folder) = run();
        assert!(read(&folder).contains("not done yet"), "{}", read(&folder));
        std::fs::create_dir(folder.path().join("model.bin")).unwrap();
        let message = read(&folder);
        assert!(message.contains("cannot read") && message.contains("it is a folder"), "{message}");
        assert!(!message.contains("not done yet"), "{message}");
    }

    /// A field of one channel, as earlier versions wrote it.
    fn wide(values: Vec<f32>) -> WideFeatureField {
        let pca = Pca {
            embedding_channels: 1,
            channels: 1,
            mean: vec![0.0],
            basis: vec![1.0],
            scale: 1.0,
            variances: vec![1.0],
            total_variance: 1.0,
        };
        let decoder =
            FeatureDecoder { channels: 1, embedding_channels: 1, weights: vec![1.0], bias: vec![0.0] };
        WideFeatureField { channels: 1, values, pca, decoder }
    }

    #[test]
    fn features_are_read_as_they_were_made_and_those_of_earlier_versions_become_the_same() {
        let (_dir, folder) = run();
        assert_eq!(folder.field().unwrap(), None);
        let values: Vec<f32> = (0..4000).map(|i| ((i * 7919 % 1013) as f32 - 500.0) * 1e-3).collect();
        let field = FeatureField::try_from(wide(values.clone())).unwrap();
        folder.write_record("features.bin", FEATURES, &field).unwrap();
        assert_eq!(folder.field().unwrap().as_ref(), Some(&field));
        let bytes = || std::fs::read(folder.path().join("features.bin")).unwrap();
        let narrow = bytes();
        folder.write_record("features.bin", WIDE_FEATURES, &wide(values.clone())).unwrap();
        let wide = bytes();
        // Two bytes less for each number; the unit and the longer kind take six.
        assert_eq!(wide.len() - narrow.len(), 2 * values.len() - 6);
        let (kind, payload) = codec::open(&wide).unwrap();
        let starts = [&1u64.to_le_bytes()[..], &4000u64.to_le_bytes(), &values[0].to_le_bytes()].concat();
        assert_eq!((kind, &payload[..20]), ("features", &starts[..]));
        assert_eq!(folder.field().unwrap(), Some(field));
    }

    #[test]
    fn features_that_are_cut_short_too_long_forged_or_of_a_later_format_are_refused_and_their_file_named() {
        let (_dir, folder) = run();
        let file = folder.path().join("features.bin");
        let refused = |bytes: &[u8], words: &str| {
            std::fs::write(&file, bytes).unwrap();
            let message = folder.field().unwrap_err().to_string();
            assert!(message.contains("features.bin") && message.contains(words), "{words}: {message}");
        };
        let values = || wide(vec![0.5; 40]);
        let field = FeatureField::try_from(values()).unwrap();
        let narrow = codec::encode(FEATURES, &field).unwrap();
        for bytes in [narrow, codec::encode(WIDE_FEATURES, &values()).unwrap()] {
            refused(&bytes[..bytes.len() - 1], "cut short");
            refused(&bytes[..30], "cut short");
            refused(&[&bytes[..], &[0]].concat(), "too many");
        }
        refused(&codec::encode("features/3", &field).unwrap(), "the version that wrote it");
        refused(&codec::encode("model", &field).unwrap(), "`model`");
        let odd = WideFeatureField { channels: 7, ..values() };
        refused(&codec::encode(WIDE_FEATURES, &odd).unwrap(), "do not fit 7 channels");
        let other = WideFeatureField { channels: 2, ..values() };
        let other = FeatureField::try_from(other).unwrap();
        refused(&codec::encode(FEATURES, &other).unwrap(), "do not fit each other");
        // Two GiB of numbers.
        refused(&codec::encode(FEATURES, &(1u64, 1.0f32, 1u64 << 30)).unwrap(), "is damaged");
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_or_an_endless_device_in_a_received_run_is_refused_and_not_waited_for() {
        for (name, device) in [("model.bin", true), ("scene.json", false), ("segwild.toml", false)] {
            let (_dir, folder) = run();
            let file = folder.path().join(name);
            match device {
                true => std::os::unix::fs::symlink("/dev/zero", &file).unwrap(),
                false => {
                    assert!(std::process::Command::new("mkfifo").arg(&file).status().unwrap().success());
                }
            }
            let message = RunFolder::open(folder.path()).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains("a pipe, a device or a socket"), "{message}");
            // Also where it came after the folder was opened.
            let message = match name {
                "model.bin" => read(&folder),
                "scene.json" => folder.intake().unwrap_err().to_string(),
                _ => format!("{:?}", folder.settings().unwrap_err()),
            };
            assert!(message.contains("a pipe, a device or a socket"), "{message}");
        }
    }
}
