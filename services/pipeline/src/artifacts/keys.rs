//! The keys of the content cache (method, section 8).
//!
//! Same key, same bytes. A key hashes everything that the artefact depends on, so that a changed setting recomputes
//! exactly what depends on it.

use super::described;
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
const FORMAT: u32 = 6;
/// The same for the feature field alone.
const FIELD: u32 = 6;
/// The same for the training, whose rules change most often: skies and embeddings, which cost most, stay.
const TRAINING: u32 = 11;

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
    /// The views of which neither masks nor descriptors are made, since others show what they do.
    left_out: BTreeSet<usize>,
}

/// Settings that a group's artefacts do not depend on. Some change only the speed or the memory; others have an effect
/// only together with another setting.
fn without_effect(settings: &Settings) -> Vec<&'static str> {
    let (train, features) = (&settings.train, &settings.features);
    // The snapshot's own key holds its step, and that of the training the perceptual term of the loss.
    let mut names = vec!["photo_cache_mib", "feature_memory", "snapshot_at", "lambda_lpips"];
    let no_embeddings = !matches!(train.appearance_model, AppearanceModel::Embed | AppearanceModel::Gsw);
    let idle = [
        ("blocks", train.blocks < 2),
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

/// What the keys of a run are made from.
struct KeyInputs<'a> {
    scene: &'a Scene,
    /// Per view, the hash of the photo's bytes; the reason where they cannot be read.
    photos: &'a [Result<String, PhotoRefusal>],
    /// The hash of imported splats.
    imported: Option<&'a str>,
    /// The hash of the weights of LPIPS.
    lpips: Option<&'a str>,
    settings: &'a Settings,
    providers: &'a Providers,
}

impl KeyInputs<'_> {
    /// Of what a model makes of a photo.
    fn photo(&self, domain: &'static str, view: usize, model: &str) -> Key {
        let digest = self.photos[view].as_ref().map_or("unreadable", String::as_str);
        photo_key(domain, digest, &self.scene.views[view], self.settings.scene.size, model)
    }

    fn sky(&self, view: usize) -> Key {
        let key = self.photo("sky", view, &self.providers.sky.key());
        if !self.providers.sky.by_points() {
            return key;
        }
        let seen = self.scene.points_in(view, 1, 1);
        Key::of("sky").key("photo", &key).part("points", format!("{seen:?}")).finish()
    }

    /// Of what is chosen before the training.
    fn choice(&self, engine: &str, sky: &[Key]) -> Key {
        let mut choice = Key::of("choice").value("format", TRAINING).part("engine", engine);
        choice = match self.imported {
            None => choice.part("settings", text::<TrainSettings>(self.settings)),
            Some(imported) => {
                choice.part("imported", imported).part("settings", of_import(&self.settings.train))
            }
        };
        choice = choice.part("points", points_digest(self.scene));
        for (i, view) in self.scene.views.iter().enumerate() {
            choice = choice
                .part(&format!("view {i}"), format!("{} {:?} {}", view.name, view.pose, view.test))
                .key(&format!("sky {i}"), &sky[i]);
        }
        choice.finish()
    }

    /// Of a training from step 0. `known`: the people and vehicles of each photo, where a network finds them.
    fn training(&self, choice: &Key, corrected: &[Option<&str>], known: Option<&[Key]>) -> Key {
        let mut training = Key::of("geometry").key("choice", choice);
        // No part without this term of the loss, so that keys of such runs stay as they were. What is chosen before the training
        // is chosen without it.
        let lambda_lpips = self.settings.train.lambda_lpips;
        if lambda_lpips > 0.0 && self.imported.is_none() {
            let weights = self.lpips.unwrap_or("none");
            training = training.part("lpips", format!("{lambda_lpips} {weights}"));
        }
        for (i, view) in self.scene.views.iter().enumerate() {
            // No part where nothing is known, so that keys of runs without corrections stay as they were.
            match (corrected.get(i).copied().flatten().filter(|_| !view.test), known) {
                (Some(digest), _) => training = training.part(&format!("transients {i}"), digest),
                (None, Some(known)) => training = training.key(&format!("transients {i}"), &known[i]),
                (None, None) => {}
            }
        }
        training.finish()
    }

    fn masks(&self, view: usize, snapshot: &Key, sky: &Key) -> Key {
        let key = Key::of("masks")
            .value("format", FORMAT)
            .part("settings", text::<MaskSettings>(self.settings))
            .part("model", self.providers.proposer.key())
            .key("snapshot", snapshot)
            .key("sky", sky)
            .value("view", view);
        match self.settings.masks.mask_source {
            MaskSource::Render => key.finish(),
            MaskSource::Photo => key.key("photo", &self.photo("photo", view, "")).finish(),
        }
    }

    fn visibility(&self, view: usize, geometry: &Key, sky: &Key) -> Key {
        Key::of("visibility")
            .key("geometry", geometry)
            .key("sky", sky)
            .key("photo", &self.photo("photo", view, ""))
            .value("view", view)
            .finish()
    }

    fn features(&self, geometry: &Key, embedding: &[Key], masks: &[Key]) -> Key {
        let mut features = Key::of("features")
            .value("format", FIELD)
            .part("settings", text::<FeatureSettings>(self.settings))
            .key("geometry", geometry);
        for (i, embedding) in embedding.iter().enumerate() {
            features = features.key(&format!("embedding {i}"), embedding);
            if self.settings.features.compactness {
                features = features.key(&format!("masks {i}"), &masks[i]);
            }
        }
        features.finish()
    }

    fn evaluation(&self, geometry: &Key) -> Key {
        let key = Key::of("evaluate")
            .key("geometry", geometry)
            .part("protocol", format!("{:?}", self.settings.protocol(false)));
        match self.lpips {
            Some(digest) => key.part("lpips", digest).finish(),
            None => key.finish(),
        }
    }
}

impl Keys {
    /// The keys of everything that a run with these settings makes. `corrected`: per view, the hash of the mask of its
    /// transients that a person has corrected. `all_described`: photos up to which all are described under
    /// `described_photos = auto`.
    pub fn of(
        scene: &Scene,
        Digests { photos: digests, imported, lpips, .. }: Digests,
        settings: &Settings,
        providers: &Providers,
        corrected: &[Option<&str>],
        engine: &str,
        end: &End,
        all_described: usize,
    ) -> Keys {
        let inputs = KeyInputs {
            scene,
            photos: &digests,
            imported: imported.as_deref(),
            lpips: lpips.as_ref().map(|file| file.digest.as_str()),
            settings,
            providers,
        };
        let views = 0..scene.views.len();
        let per_view = |key: &dyn Fn(usize) -> Key| -> Vec<Key> { views.clone().map(key).collect() };
        let sky = per_view(&|view| inputs.sky(view));
        let embedding = per_view(&|view| inputs.photo("embedding", view, &providers.embedder.key()));
        let network = providers.transients.as_ref().map(|network| network.key());
        let finder = network.as_deref().unwrap_or("none");
        let known_transients = per_view(&|view| inputs.photo("transients", view, finder));

        let choice = inputs.choice(engine, &sky);
        let whole = inputs.training(&choice, corrected, network.is_some().then_some(&known_transients[..]));
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
        let masks = per_view(&|view| inputs.masks(view, &snapshot, &sky[view]));
        let visibility = per_view(&|view| inputs.visibility(view, &geometry, &sky[view]));
        let takes_part = |i: &usize| !scene.views[*i].test && digests[*i].is_ok();
        let usable: Vec<usize> = views.clone().filter(takes_part).collect();
        let left_out = described::left_out(scene, settings.run.described_photos, all_described, &usable);
        let features = inputs.features(&geometry, &embedding, &masks);
        // The same key where no photo is left out, so that those of such runs stay as they were.
        let features =
            if left_out.is_empty() { features } else { key_without(&features, "description", &left_out) };
        let evaluation = inputs.evaluation(&geometry);
        let masked: Option<BTreeMap<usize, bool>> = match providers.segmenter.finds_objects() {
            true => Some(usable.into_iter().filter(|i| !left_out.contains(i)).map(|i| (i, true)).collect()),
            false => None,
        };
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
            features,
            masks_in_field: settings.features.compactness,
            snapshot_step: settings.train.snapshot_step(),
            history: history_of(&geometry.to_string()),
            evaluation,
            segmenter: providers.segmenter.key(),
            masked,
            left_out,
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

    /// Whether masks and descriptors are made of a view's photo, if it is trained on.
    pub fn is_described(&self, view: usize) -> bool {
        !self.left_out.contains(&view)
    }

    /// The photos of which neither masks nor descriptors are made.
    pub fn left_out(&self) -> usize {
        self.left_out.len()
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_of_one_block_has_the_key_that_it_had_before_there_were_blocks() {
        let of = |blocks: usize| {
            let mut settings = Settings::default();
            settings.train.blocks = blocks;
            text::<TrainSettings>(&settings)
        };
        assert!(!of(1).contains("blocks") && of(0) == of(1), "{}", of(1));
        assert!(of(4).contains("blocks=4\n") && of(4) != of(2), "{}", of(4));
    }
}
