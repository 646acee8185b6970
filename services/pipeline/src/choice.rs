//! `--look auto`: the choice is made once, kept under the name of all it depends on, and said.

use crate::artefacts::Keys;
use crate::strangers::Known;
use crate::{RunError, RunFolder, Settings};
use segwild_flow::{Cache, CacheError, Key};
use segwild_raster::Engine;
use segwild_scene::{Mask, Scene};
use segwild_trainer::{CHOICE_SIZE, LookChoice, LookKind, TrainError, TrainPhoto, choose_look};
use segwild_vision::SkyDetector;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Kind of the cache's record.
const KIND: &str = "look";
/// Where the run folder says it.
pub(crate) const FILE: &str = "look.json";

/// The name of a choice, from the keys of a training whose look is `auto`.
pub(crate) fn key(keys: &Keys) -> Key {
    Key::of(KIND).key("training", &keys.training).finish()
}

/// The choice, if it was made before.
pub(crate) fn kept(cache: &Cache, keys: &Keys) -> Result<Option<LookChoice>, CacheError> {
    let text: Option<String> = cache.get_typed(&key(keys), KIND)?;
    Ok(text.and_then(|text| serde_json::from_str(&text).ok()))
}

/// What a choice is made from.
pub(crate) struct Chooser<'a> {
    pub folder: &'a RunFolder,
    pub cache: &'a Cache,
    pub scene: &'a Arc<Scene>,
    pub settings: &'a Settings,
    pub engine: &'a Arc<dyn Engine>,
    pub sky: &'a Arc<dyn SkyDetector>,
    pub known: &'a Known,
}

impl Chooser<'_> {
    /// The settings with the look decided, and the choice; `keys` are those of the settings as they are.
    pub fn choose(
        &self,
        keys: &Keys,
        stopping: &dyn Fn() -> bool,
    ) -> Result<(Settings, LookChoice), RunError> {
        let choice = match kept(self.cache, keys)? {
            Some(choice) => choice,
            None => {
                let choice = self.decide(stopping)?;
                let text = serde_json::to_string(&choice).unwrap_or_default();
                self.cache.put_typed(&key(keys), KIND, &text)?;
                choice
            }
        };
        self.folder.write_json(FILE, &choice)?;
        Ok((decided(self.settings, &choice), choice))
    }

    fn decide(&self, stopping: &dyn Fn() -> bool) -> Result<LookChoice, RunError> {
        let (scene, sky, known) = (self.scene.clone(), self.sky.clone(), self.known.clone());
        let size = CHOICE_SIZE.min(self.settings.scene.size);
        // Few and small, and asked for again and again.
        let held: Mutex<BTreeMap<usize, Result<TrainPhoto, String>>> = Mutex::default();
        let read = move |view: usize| -> Result<TrainPhoto, String> {
            let loaded = scene.views[view].load(size).map_err(|e| e.to_string())?;
            // Without its sky a photo still tells something.
            let seen = scene.seen_by(view, loaded.image.width, loaded.image.height);
            let sky: Option<Mask> = sky.sky_above(&loaded.image, &seen).ok();
            let mut photo = TrainPhoto { image: loaded.image, valid: loaded.valid, sky, strangers: None };
            known.tell_hand(view, &mut photo);
            Ok(photo)
        };
        let photos = Arc::new(move |view: usize| {
            let mut held = held.lock().unwrap_or_else(PoisonError::into_inner);
            held.entry(view).or_insert_with(|| read(view)).clone()
        });
        choose_look(self.engine.clone(), self.scene, photos, &self.settings.train, stopping).map_err(
            |error| match error {
                TrainError::Stopped => RunError::Interrupted,
                error => RunError::Stage { stage: "geometry", reason: error.to_string() },
            },
        )
    }
}

/// The settings with a look decided.
pub(crate) fn decided(settings: &Settings, choice: &LookChoice) -> Settings {
    let mut settings = settings.clone();
    settings.train.look = choice.look;
    settings
}

/// Whether a look is still to be chosen.
pub(crate) fn is_open(settings: &Settings) -> bool {
    settings.train.look == LookKind::Auto
}
