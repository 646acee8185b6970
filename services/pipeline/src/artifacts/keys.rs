//! The keys of the content cache (method, section 8).
//!
//! Same key, same bytes. A key hashes everything that the artefact depends on, so that a changed setting recomputes
//! exactly what depends on it.

use super::digests::{Digests, PhotoRefusal};
use super::scene_tree::{masked_tree_key, tree_key};
use crate::Settings;
use segwild_features::{Compression, FeatureSettings};
use segwild_flow::Key;
use segwild_masks::{MaskSettings, MaskSource};
use segwild_scene::settings::Group;
use segwild_scene::{Scene, View};
use segwild_trainer::{AppearanceModel, TrainSettings};
use segwild_vision::Providers;
use std::collections::{BTreeMap, BTreeSet};

/// Raised when the bytes that a stage makes from the same input change.
const FORMAT: u32 = 5;
/// The same for the training, whose rules change most often: skies and embeddings, which cost most, stay.
const TRAINING: u32 = 10;

/// The keys of one run.
#[derive(Clone, Debug)]
pub struct Keys {
    /// Per view, the hash of the photo's bytes; the reason where they cannot be read.
    digests: Vec<Result<String, PhotoRefusal>>,
    /// Per view, its sky.
    pub sky: Vec<Key>,
    /// Per view, its embedding.
    pub embedding: Vec<Key>,
    /// The training that checkpoints belong to, whatever number of steps it is given.
    pub training: Key,
    /// What is chosen before the training (`auto`). It does not depend on transients that a person has corrected: a correction
    /// goes on with the choice that was made.
    pub choice: Key,
    /// The trained scene.
    pub geometry: Key,
    /// The scene at the snapshot step.
    pub snapshot: Key,
    snapshot_step: u32,
    /// Per view, its masks.
    pub masks: Vec<Key>,
    /// Per view, its visibility.
    pub visibility: Vec<Key>,
    /// Per view, the people and vehicles that a network finds.
    pub known_transients: Vec<Key>,
    /// The feature field.
    pub features: Key,
    /// Whether the field depends on the masks (compactness).
    masks_in_field: bool,
    /// How the training went.
    pub history: Key,
    /// The scores of the held-out photos.
    pub evaluation: Key,
    /// Key of the provider whose boundaries the scene tree is grown from.
    segmenter: String,
    /// Where the tree is grown from masks instead: the views that take part, and whether each has masks.
    masked: Option<BTreeMap<usize, bool>>,
}

/// Settings that a group's artefacts do not depend on. Some change only the speed or the memory; others have an effect
/// only together with another setting.
fn without_effect(settings: &Settings) -> Vec<&'static str> {
    let (train, features) = (&settings.train, &settings.features);
    // The snapshot's own key holds its step, and that of the training the perceptual term of the loss.
    let mut names = vec!["photo_cache_mib", "feature_memory", "snapshot_at", "lambda_lpips"];
    let no_embeddings = !matches!(train.appearance_model, AppearanceModel::Embed | AppearanceModel::Gsw);
    let idle = [
        ("lr_splat_embedding", no_embeddings),
        ("splat_embedding_from", no_embeddings),
        ("lr_net", train.appearance_model != AppearanceModel::Gsw),
        ("gsw_width", train.appearance_model != AppearanceModel::Gsw),
        ("decoder_lr", features.compression != Compression::Learned),
        ("weight_compact", !features.compactness),
    ];
    names.extend(idle.iter().filter(|(_, idle)| *idle).map(|(name, _)| *name));
    names
}

/// The training that another one continues.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrainingOrigin {
    /// Key of the training before.
    pub training: Key,
    /// The step it ended at.
    pub step: u32,
    /// The step that the continued training ends at.
    pub end: u32,
    /// Key of the snapshot that masks are proposed from: that of the training without corrections.
    pub snapshot: Key,
}

/// The first and the last step of a training.
#[derive(Clone, Debug)]
pub enum End {
    /// From step 0 to the steps of the settings.
    Settings,
    /// From step 0 to this step, which may lie past the steps of the settings.
    Step(u32),
    /// From the last step of another training to some steps later.
    ContinuedTraining(TrainingOrigin),
}

impl End {
    /// The step to stop at, if one is given.
    pub fn step(&self) -> Option<u32> {
        match self {
            End::Settings => None,
            End::Step(step) => Some(*step),
            End::ContinuedTraining(origin) => Some(origin.end),
        }
    }
}

impl Keys {
    /// The keys of everything that a run with these settings makes. `corrected`: per view, the hash of the mask of its
    /// transients that a person has corrected.
    pub fn of(
        scene: &Scene,
        Digests { photos: digests, imported, lpips, .. }: Digests,
        settings: &Settings,
        providers: &Providers,
        corrected: &[Option<&str>],
        engine: &str,
        end: &End,
    ) -> Keys {
        let photo = |domain: &'static str, i: usize, model: &str| {
            let digest = digests[i].as_ref().map_or("unreadable", String::as_str);
            photo_key(domain, digest, &scene.views[i], settings.scene.size, model)
        };
        let views = 0..scene.views.len();
        let sky: Vec<Key> = views
            .clone()
            .map(|i| {
                let key = photo("sky", i, &providers.sky.key());
                if !providers.sky.by_points() {
                    return key;
                }
                let seen = scene.points_in(i, 1, 1);
                Key::of("sky").key("photo", &key).part("points", format!("{seen:?}")).finish()
            })
            .collect();
        let embedding: Vec<Key> =
            views.clone().map(|i| photo("embedding", i, &providers.embedder.key())).collect();

        let network = providers.transients.as_ref().map(|network| network.key());
        let known_transients: Vec<Key> =
            views.clone().map(|i| photo("transients", i, network.as_deref().unwrap_or("none"))).collect();

        let mut choice = Key::of("choice").value("format", TRAINING).part("engine", engine);
        choice = match &imported {
            None => choice.part("settings", text::<TrainSettings>(settings)),
            Some(imported) => choice.part("imported", imported).part("settings", of_import(&settings.train)),
        };
        choice = choice.part("points", points_digest(scene));
        for (i, view) in scene.views.iter().enumerate() {
            choice = choice
                .part(&format!("view {i}"), format!("{} {:?} {}", view.name, view.pose, view.test))
                .key(&format!("sky {i}"), &sky[i]);
        }
        let choice = choice.finish();
        let mut training = Key::of("geometry").key("choice", &choice);
        let lpips = lpips.as_ref().map(|file| file.digest.as_str());
        // No part without this term of the loss, so that keys of such runs stay as they were. What is chosen before the training
        // is chosen without it.
        if settings.train.lambda_lpips > 0.0 && imported.is_none() {
            let weights = lpips.unwrap_or("none");
            training = training.part("lpips", format!("{} {weights}", settings.train.lambda_lpips));
        }
        for (i, view) in scene.views.iter().enumerate() {
            // No part where nothing is known, so that keys of runs without corrections stay as they were.
            match corrected.get(i).copied().flatten().filter(|_| !view.test) {
                Some(digest) => training = training.part(&format!("transients {i}"), digest),
                None if network.is_some() => {
                    training = training.key(&format!("transients {i}"), &known_transients[i]);
                }
                None => {}
            }
        }
        let whole = training.finish();
        let training = match end {
            End::ContinuedTraining(origin) => Key::of("geometry")
                .key("whole", &whole)
                .key("from", &origin.training)
                .value("step", origin.step)
                .value("end", origin.end)
                .finish(),
            End::Settings | End::Step(_) => whole,
        };
        let geometry = match *end {
            End::Step(steps) if steps > settings.train.steps => {
                Key::of("geometry").key("training", &training).value("steps", steps).finish()
            }
            _ => training,
        };
        let snapshot = match end {
            End::ContinuedTraining(origin) => origin.snapshot,
            _ => snapshot_of(&training, settings.train.snapshot_step()),
        };
        let masks: Vec<Key> = views
            .clone()
            .map(|i| {
                let key = Key::of("masks")
                    .value("format", FORMAT)
                    .part("settings", text::<MaskSettings>(settings))
                    .part("model", providers.proposer.key())
                    .key("snapshot", &snapshot)
                    .key("sky", &sky[i])
                    .value("view", i);
                match settings.masks.mask_source {
                    MaskSource::Render => key.finish(),
                    MaskSource::Photo => key.key("photo", &photo("photo", i, "")).finish(),
                }
            })
            .collect();
        let visibility = views
            .clone()
            .map(|i| {
                Key::of("visibility")
                    .key("geometry", &geometry)
                    .key("sky", &sky[i])
                    .key("photo", &photo("photo", i, ""))
                    .value("view", i)
                    .finish()
            })
            .collect();
        let takes_part = |i: &usize| !scene.views[*i].test && digests[*i].is_ok();
        let masked: Option<BTreeMap<usize, bool>> = match providers.segmenter.finds_objects() {
            true => Some(views.clone().filter(takes_part).map(|i| (i, true)).collect()),
            false => None,
        };
        let mut features = Key::of("features")
            .value("format", FORMAT)
            .part("settings", text::<FeatureSettings>(settings))
            .key("geometry", &geometry);
        for i in views {
            features = features.key(&format!("embedding {i}"), &embedding[i]);
            if settings.features.compactness {
                features = features.key(&format!("masks {i}"), &masks[i]);
            }
        }
        Keys {
            digests,
            sky,
            embedding,
            training,
            choice,
            geometry,
            snapshot,
            masks,
            visibility,
            known_transients,
            features: features.finish(),
            masks_in_field: settings.features.compactness,
            snapshot_step: settings.train.snapshot_step(),
            history: history_of(&geometry.to_string()),
            evaluation: lpips
                .iter()
                .fold(
                    Key::of("evaluate")
                        .key("geometry", &geometry)
                        .part("protocol", format!("{:?}", settings.protocol(false))),
                    |key, digest| key.part("lpips", digest),
                )
                .finish(),
            segmenter: providers.segmenter.key(),
            masked,
        }
    }

    /// The keys of a run without the skies of some photos, which were given up. Skies of `views` change the trained
    /// scene and all that depends on it; skies of `held_out` photos change the scores only. A run that finds those
    /// skies makes something else and must not reuse this.
    pub fn without_skies(&self, views: &BTreeSet<usize>, held_out: &BTreeSet<usize>) -> Keys {
        let mut keys = if views.is_empty() { self.clone() } else { self.without_training_skies(views) };
        if !held_out.is_empty() {
            keys.evaluation = key_without(&keys.evaluation, "sky", held_out);
        }
        keys
    }

    fn without_training_skies(&self, views: &BTreeSet<usize>) -> Keys {
        let without = |whole: &Key| key_without(whole, "sky", views);
        let training = without(&self.training);
        let geometry = if self.geometry == self.training { training } else { without(&self.geometry) };
        Keys {
            geometry,
            snapshot: snapshot_of(&training, self.snapshot_step),
            masks: self.masks.iter().map(without).collect(),
            visibility: self.visibility.iter().map(without).collect(),
            features: without(&self.features),
            history: history_of(&geometry.to_string()),
            evaluation: without(&self.evaluation),
            training,
            ..self.clone()
        }
    }

    /// The key of the field without the embeddings, the masks or the visibility of some photos.
    pub fn features_without(
        &self,
        embeddings: &BTreeSet<usize>,
        masks: &BTreeSet<usize>,
        visibility: &BTreeSet<usize>,
    ) -> Key {
        let parts = [
            ("embedding", embeddings, true),
            ("masks", masks, self.masks_in_field),
            ("visibility", visibility, true),
        ];
        let missing = parts.iter().filter(|(_, views, matters)| *matters && !views.is_empty());
        missing.fold(self.features, |key, (what, views, _)| key_without(&key, what, views))
    }

    /// The key of the scores without those of some photos.
    pub fn evaluation_without(&self, photos: &BTreeSet<usize>) -> Key {
        if photos.is_empty() { self.evaluation } else { key_without(&self.evaluation, "score", photos) }
    }

    /// The key of a view's transient mask, whose boundaries `segmenter` refines.
    pub fn transients(&self, view: usize, segmenter: &str) -> Key {
        Key::of("transients").key("visibility", &self.visibility[view]).part("model", segmenter).finish()
    }

    /// The view that an artefact belongs to, by the artefact's key as the ledger writes it.
    pub fn view_of(&self, key: &str) -> Option<usize> {
        let all = [&self.sky, &self.embedding, &self.masks, &self.visibility, &self.known_transients];
        all.into_iter().find_map(|keys| keys.iter().position(|k| k.to_string() == key))
    }

    /// The key of the tree of the trained scene.
    pub(crate) fn scene_tree(&self) -> Key {
        let geometry = self.geometry.to_string();
        match &self.masked {
            None => tree_key(&geometry, &self.segmenter),
            Some(masked) => {
                let masks = masked.iter().map(|(&view, has)| (view, has.then(|| self.masks[view])));
                masked_tree_key(&geometry, &masks.collect())
            }
        }
    }

    /// Grows the scene tree without the masks of some photos, which were given up.
    pub fn give_up_masks(&mut self, views: &BTreeSet<usize>) {
        let masked = self.masked.iter_mut().flatten();
        masked.filter(|(view, _)| views.contains(*view)).for_each(|(_, has)| *has = false);
    }

    /// By view, the reason why its photo cannot be used; `None` where it can.
    pub fn refused(&self) -> Vec<Option<String>> {
        self.digests.iter().map(|digest| digest.as_ref().err().map(ToString::to_string)).collect()
    }

    /// The reason why a view's photo cannot be used; `None` where it can.
    pub(crate) fn unreadable(&self, view: usize) -> Option<&PhotoRefusal> {
        self.digests[view].as_ref().err()
    }
}

/// The settings that the fit of imported splats depends on.
fn of_import(train: &TrainSettings) -> String {
    format!("{} {} {}", train.appearance_model, train.robust, train.robust_share)
}

/// The key of what is made without one input of some photos.
fn key_without(whole: &Key, what: &str, views: &BTreeSet<usize>) -> Key {
    let list: Vec<String> = views.iter().map(usize::to_string).collect();
    Key::of(whole.domain()).key("whole", whole).part(&format!("without {what}"), list.join(" ")).finish()
}

/// The key of a training's snapshot at a step.
fn snapshot_of(training: &Key, step: u32) -> Key {
    Key::of("snapshot").key("training", training).value("step", step).finish()
}

/// The key of a training's history, from the trained scene's key as the ledger writes it.
pub(crate) fn history_of(geometry: &str) -> Key {
    Key::of("history").part("geometry", geometry).finish()
}

/// The key of what a model makes of a photo at a long side of `size` pixels.
pub(crate) fn photo_key(domain: &'static str, digest: &str, view: &View, size: u32, model: &str) -> Key {
    let key = Key::of(domain)
        .part("photo", digest)
        .value("format", FORMAT)
        .value("size", size)
        .part("camera", format!("{:?} {:?}", view.camera, view.photo.lens))
        .part("model", model);
    // Only cut-outs have this part, so that the keys of other photos stay as they were.
    match view.photo.reading.empty {
        true => key.part("transparent", "empty").finish(),
        false => key.finish(),
    }
}

/// Hash of the points that training starts from.
fn points_digest(scene: &Scene) -> String {
    let mut hasher = blake3::Hasher::new();
    for point in &scene.points {
        for value in point.position.to_array().iter().chain(&point.colour) {
            hasher.update(&value.to_le_bytes());
        }
        for seen in &point.track {
            hasher.update(&seen.view.to_le_bytes());
        }
    }
    if scene.colourless().is_some() {
        hasher.update(b"coloured from the photos");
    }
    hasher.finalize().to_hex().to_string()
}

/// A group's settings as text, one per line.
fn text<G: Group>(settings: &Settings) -> String {
    let idle = without_effect(settings);
    G::FIELDS
        .iter()
        .filter(|f| !idle.contains(&f.name))
        .map(|f| format!("{}={}\n", f.name, settings.get(f.name).unwrap_or_default()))
        .collect()
}
