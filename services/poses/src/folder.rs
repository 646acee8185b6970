//! The folder of poses: what is there, and what is to be made.

use crate::database::{Database, ImageRow};
use crate::models::others_in_words;
use crate::pairs::decided;
use crate::record::{FileStamp, PosesRecord};
use crate::{PoseMapper, PoseSettings, PoseSource, PosesError};
use rayon::prelude::*;
use segwild_flow::Key;
use segwild_scene::{PosedPhotos, SceneError, SceneSettings, UnposedPhotos, few_of_photos};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The folder in which poses are computed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PosesFolder {
    path: PathBuf,
}

/// What is to be done for the poses of a source.
#[derive(Clone, Debug)]
pub struct PosePlan {
    /// Key of all that the poses are made from.
    pub key: Key,
    /// Why they are to be made, a phrase each; empty where they are there.
    pub why: Vec<String>,
    pub(crate) inputs: PoseInputs,
}

impl PosePlan {
    /// Whether the poses are there.
    pub fn is_done(&self) -> bool {
        self.why.is_empty()
    }
}

/// What the poses are made from.
#[derive(Clone, Debug)]
pub(crate) struct PoseInputs {
    /// Key of all that features depend on beside the photos.
    pub features: Key,
    pub photos: BTreeMap<String, FileStamp>,
    pub video: Option<FileStamp>,
}

impl PosesFolder {
    /// The folder at a path, there or not.
    pub fn at(path: PathBuf) -> PosesFolder {
        PosesFolder { path }
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn database(&self) -> PathBuf {
        self.path.join("colmap.db")
    }

    pub(crate) fn open_database(&self) -> Result<Option<Database>, PosesError> {
        Database::open(&self.database())
    }

    /// The photos in the database, by name.
    pub(crate) fn images(&self) -> Result<BTreeMap<String, ImageRow>, PosesError> {
        self.open_database()?.map_or(Ok(BTreeMap::new()), |database| database.images())
    }

    pub(crate) fn models(&self) -> PathBuf {
        self.path.join("models")
    }

    /// What COLMAP's mapper leaves on its way.
    pub(crate) fn snapshots(&self) -> PathBuf {
        self.path.join("snapshots")
    }

    pub(crate) fn frames(&self) -> PathBuf {
        self.path.join("frames")
    }

    /// What is to be done for the poses of a source under these settings.
    ///
    /// # Errors
    /// When a photo or the record cannot be read.
    pub fn plan(&self, source: &PoseSource, settings: &PoseSettings) -> Result<PosePlan, PosesError> {
        let before = PosesRecord::read(&self.path)?.unwrap_or_default();
        let inputs = PoseInputs::of(source, settings, &before)?;
        let key = inputs.key(source, settings);
        let done = before.done.as_ref();
        let model = done.and_then(|done| done.models.first()).map(|model| self.model(model.number));
        let why = match done {
            Some(done) if done.key == key.to_string() && model.is_some_and(|model| model.is_dir()) => {
                Vec::new()
            }
            Some(done) if done.key == key.to_string() => vec!["its results are gone".into()],
            Some(_) => inputs.changes(&before),
            None if before == PosesRecord::default() => vec!["the photos have no poses yet".into()],
            None => vec!["it was interrupted".into()],
        };
        Ok(PosePlan { key, why, inputs })
    }

    pub(crate) fn model(&self, number: u32) -> PathBuf {
        self.models().join(number.to_string())
    }

    /// The photos of the source at `path` with the poses that are there, whatever has changed since; `None` where there are none.
    ///
    /// # Errors
    /// When the record is damaged, or the photos are gone.
    pub fn posed(&self, path: &Path, settings: &SceneSettings) -> Result<Option<PosedPhotos>, PosesError> {
        let Some(done) = PosesRecord::read(&self.path)?.and_then(|record| record.done) else {
            return Ok(None);
        };
        let Some(model) = done.models.first().map(|model| self.model(model.number)) else { return Ok(None) };
        let scene = if path.is_dir() { path } else { self.path() };
        let found = match path.is_dir() {
            true => UnposedPhotos::find(path, settings)?,
            false => UnposedPhotos::find(&self.frames(), &SceneSettings::default())?,
        };
        let missing =
            || SceneError::NothingUsable { path: path.to_owned(), reason: "its photos are gone".into() };
        let UnposedPhotos { folder, skipped, .. } = found.ok_or_else(missing)?;
        let notes = others_in_words(&done.models).into_iter().collect();
        let unposed = done.unposed.into_iter().chain(skipped).collect();
        Ok(Some(PosedPhotos { scene: scene.to_owned(), photos: folder, model, unposed, notes }))
    }
}

impl PoseInputs {
    fn of(
        source: &PoseSource,
        settings: &PoseSettings,
        before: &PosesRecord,
    ) -> Result<PoseInputs, PosesError> {
        let (photos, video) = match source {
            PoseSource::Photos { photos, .. } => (stamps(photos, before)?, None),
            PoseSource::Video(path) => {
                let stamp = FileStamp::of(path, before.video.as_ref()).map_err(SceneError::io(path))?;
                (BTreeMap::new(), Some(stamp))
            }
        };
        let key = Key::of("pose features")
            .value("sharing", settings.camera_sharing)
            .value("size", settings.pose_photo_size);
        let key = match &video {
            Some(video) => key.part("video", &video.digest).value("frames", settings.video_frames),
            None => key,
        };
        Ok(PoseInputs { features: key.finish(), photos, video })
    }

    fn key(&self, source: &PoseSource, settings: &PoseSettings) -> Key {
        let of_video = matches!(source, PoseSource::Video(_));
        // How many frames a video gives is not known yet; what gives them is in the key of the features.
        let pairs = match of_video {
            true => settings.pair_choice,
            false => decided(settings.pair_choice, self.photos.len(), of_video),
        };
        let key = Key::of("poses").key("features", &self.features).value("pairs", pairs);
        // What `auto` finds on a machine is no reason to compute poses again.
        let key = match settings.mapper {
            PoseMapper::Auto => key,
            named => key.value("mapper", named),
        };
        let of_photo = |key: segwild_flow::KeyBuilder, (name, stamp): (&String, &FileStamp)| {
            key.part("photo", name).part("content", &stamp.digest)
        };
        self.photos.iter().fold(key, of_photo).finish()
    }

    /// What differs from a record that is done, a phrase each.
    fn changes(&self, before: &PosesRecord) -> Vec<String> {
        let of = |name: &String, stamp: &FileStamp| match before.photos.get(name) {
            None => Some(format!("{name} is new")),
            Some(old) if old.digest != stamp.digest => Some(format!("{name} has changed")),
            Some(_) => None,
        };
        let mut all: Vec<String> = self.photos.iter().filter_map(|(name, stamp)| of(name, stamp)).collect();
        let gone =
            before.photos.keys().filter(|name| self.video.is_none() && !self.photos.contains_key(*name));
        all.extend(gone.map(|name| format!("{name} is gone")));
        match all.len() {
            0 => vec!["its settings or the video have changed".into()],
            _ => few_of_photos(all),
        }
    }

    /// Whether the features in the database are of these inputs, as far as it has them.
    pub fn fit(&self, before: &PosesRecord) -> bool {
        let same = |(name, stamp): (&String, &FileStamp)| {
            before.photos.get(name).is_none_or(|b| b.digest == stamp.digest)
        };
        before.features == self.features.to_string() && self.photos.iter().all(same)
    }
}

/// The photos as they are now.
pub(crate) fn stamps(
    photos: &UnposedPhotos,
    before: &PosesRecord,
) -> Result<BTreeMap<String, FileStamp>, PosesError> {
    let of = |name: &String| {
        let path = photos.folder.join(name);
        let stamp = FileStamp::of(&path, before.photos.get(name)).map_err(SceneError::io(&path))?;
        Ok((name.clone(), stamp))
    };
    photos.photos.par_iter().map(|photo| of(&photo.name)).collect()
}
