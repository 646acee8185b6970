//! `--appearance-model auto` and `--budget auto`: each choice is made once, kept in the cache under a key of all that
//! it depends on, and reported.

use crate::artifacts::auto_choice::AutoChoice;
use crate::artifacts::keys::Keys;
use crate::{RunError, RunFolder, Settings};
use segwild_flow::{Cache, CacheError, Key, lock};
use segwild_objective::Engine;
use segwild_scene::{Mask, PhotoStore, Scene, SceneError};
use segwild_trainer::{
    AppearanceChoice, BudgetChoice, CHOICE_SIZE, Photos, Sifted, TrainError, TrainPhoto, choose_appearance,
    choose_budget, trial_size,
};
use segwild_vision::SkyDetector;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

/// Whether a budget may exceed the steps of the settings: the steps were left to the scene, and its photos agree.
fn beyond(steps_open: bool, appearance: Option<&AppearanceChoice>) -> bool {
    steps_open && appearance.is_some_and(AppearanceChoice::agrees)
}

/// The key of a choice, from the keys of a run that leaves it open, and what else it depends on: for the appearance
/// model whether the budget is open too, for the budget whether it may exceed the settings.
fn key<C: AutoChoice>(keys: &Keys, flag: bool) -> Key {
    Key::of(C::KIND).value("rule", C::RULE).key("choice", &keys.choice).value("flag", flag).finish()
}

/// The choice, if it was made before.
pub(super) fn kept<C: AutoChoice>(cache: &Cache, key: &Key) -> Result<Option<C>, CacheError> {
    let text: Option<String> = cache.get_typed(key, C::KIND)?;
    Ok(text.and_then(|text| serde_json::from_str(&text).ok()))
}

/// The settings with the choices that earlier runs have made. `steps_open` says whether the steps were left to the
/// scene; `keys` computes the keys of a run with given settings.
pub(crate) fn decided_before(
    cache: &Cache,
    settings: &Settings,
    steps_open: bool,
    keys: &dyn Fn(&Settings) -> Keys,
) -> Result<Settings, CacheError> {
    let (mut settings, mut appearance) = (settings.clone(), None);
    if AppearanceChoice::is_open(&settings) {
        let key = key::<AppearanceChoice>(&keys(&settings), BudgetChoice::is_open(&settings));
        match kept::<AppearanceChoice>(cache, &key)? {
            Some(choice) => settings = appearance.insert(choice).decided(&settings, steps_open),
            None => return Ok(settings),
        }
    }
    if BudgetChoice::is_open(&settings) {
        let key = key::<BudgetChoice>(&keys(&settings), beyond(steps_open, appearance.as_ref()));
        match kept::<BudgetChoice>(cache, &key)? {
            Some(choice) => settings = choice.decided(&settings, steps_open),
            None => return Ok(settings),
        }
    }
    Ok(settings)
}

/// The inputs of a choice.
pub(crate) struct Chooser<'a> {
    pub folder: &'a RunFolder,
    pub cache: &'a Cache,
    pub scene: &'a Arc<Scene>,
    pub engine: &'a Arc<dyn Engine>,
    pub sky: &'a Arc<dyn SkyDetector>,
    /// Whether the steps were left to the scene.
    pub steps_open: bool,
    /// Computes the keys of a run with given settings.
    pub keys: &'a dyn Fn(&Settings) -> Keys,
    /// Ends the work.
    pub stopping: &'a dyn Fn() -> bool,
}

impl Chooser<'_> {
    /// Makes the choices that the settings leave open: first the appearance model, then the budget. `on_choice` is
    /// called for each with its kind, its key and the reason.
    ///
    /// # Errors
    /// When a trial training fails, the cache or the folder cannot be written, or the run is stopped.
    pub fn choose(
        &self,
        settings: &Settings,
        mut on_choice: impl FnMut(&'static str, &Key, &str) -> Result<(), RunError>,
    ) -> Result<Settings, RunError> {
        let scene = &**self.scene;
        let trial_size = |settings: &Settings| trial_size(scene, settings.scene.size);
        let agreement = BudgetChoice::is_open(settings);
        let appearance = |settings: &Settings| {
            let photos = self.photos(CHOICE_SIZE.min(trial_size(settings)), settings);
            choose_appearance(self.engine.clone(), scene, photos, &settings.train, agreement, self.stopping)
        };
        let (settings, appearance) =
            self.one::<AppearanceChoice>(settings, agreement, appearance, &mut on_choice)?;
        let beyond = beyond(self.steps_open, appearance.as_ref());
        let budget = |settings: &Settings| {
            let photos = self.photos(trial_size(settings), settings);
            choose_budget(self.engine.clone(), scene, photos, &settings.train, beyond, self.stopping)
        };
        let (settings, _) = self.one::<BudgetChoice>(&settings, beyond, budget, &mut on_choice)?;
        Ok(settings)
    }

    fn one<C: AutoChoice>(
        &self,
        settings: &Settings,
        flag: bool,
        make: impl Fn(&Settings) -> Result<C, TrainError>,
        on_choice: &mut impl FnMut(&'static str, &Key, &str) -> Result<(), RunError>,
    ) -> Result<(Settings, Option<C>), RunError> {
        if !C::is_open(settings) {
            return Ok((settings.clone(), None));
        }
        let key = key::<C>(&(self.keys)(settings), flag);
        let choice = match kept::<C>(self.cache, &key)? {
            Some(choice) => choice,
            None => {
                let choice = make(settings).map_err(|error| match error {
                    TrainError::Stopped => RunError::Interrupted,
                    error => RunError::Stage { stage: "geometry", reason: error.to_string() },
                })?;
                let text = serde_json::to_string(&choice).unwrap_or_default();
                self.cache.put_typed(&key, C::KIND, &text)?;
                choice
            }
        };
        self.folder.write_json(C::FILE, &choice)?;
        on_choice(C::KIND, &key, choice.why())?;
        Ok((choice.decided(settings, self.steps_open), Some(choice)))
    }

    fn photos(&self, size: u32, settings: &Settings) -> Arc<dyn Photos> {
        held_photos(self.scene, self.sky, (self.keys)(settings).refused(), size)
    }
}

/// Photos with long side `size` and their skies; `refused`: per view, why its photo cannot be used. They are few and are requested
/// many times, so that they are held in memory.
pub(super) fn held_photos(
    scene: &Arc<Scene>,
    sky: &Arc<dyn SkyDetector>,
    refused: Vec<Option<String>>,
    size: u32,
) -> Arc<dyn Photos> {
    let (scene, sky) = (scene.clone(), sky.clone());
    // They are held below, with their skies.
    let store = PhotoStore::new(scene.clone(), size, 0);
    let held: Mutex<BTreeMap<usize, Result<TrainPhoto, Arc<SceneError>>>> = Mutex::default();
    let read = move |view: usize| -> Result<TrainPhoto, Arc<SceneError>> {
        let loaded = store.read(view)?;
        // A photo is used even without its sky.
        let seen = scene.points_in(view, loaded.image.width, loaded.image.height);
        let sky: Option<Mask> = sky.sky_above(&loaded.image, &seen).ok();
        Ok(TrainPhoto::new(Arc::unwrap_or_clone(loaded), sky))
    };
    let photos = move |view: usize| -> Result<TrainPhoto, Arc<SceneError>> {
        let mut held = lock(&held);
        held.entry(view).or_insert_with(|| read(view)).clone()
    };
    Arc::new(Sifted { photos, refused })
}
