//! Every setting of a run in one struct, and its defaults by preset, budget and scene.

use super::former::renamed;
use super::whole_run::{RunBudget, RunSettings, Scoring};
use segwild_features::{Compression, FeatureSettings};
use segwild_masks::MaskSettings;
use segwild_poses::PoseSettings;
use segwild_scene::settings::{Field, Group, SettingError};
use segwild_scene::{Scene, SceneSettings};
use segwild_segmenter::{CutBy, EvidenceMode, FirstAnswer, SegmentSettings, SimilarityUse, SpikeMode};
use segwild_trainer::{AppearanceModel, Preset, Protocol, TrainSettings};
use segwild_vision::VisionSettings;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Share of the embedding's variance that is worth channels under `--budget auto`.
const KEEP_VARIANCE: f32 = 0.99;

macro_rules! compose {
    ($($field:ident : $group:ty),+ $(,)?) => {
        /// Every setting of a run; each field is a table of `segwild.toml`.
        #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct Settings { $(#[allow(missing_docs)] pub $field: $group,)+ }

        impl Settings {
            /// The tables in order: name, what it is about, its settings.
            pub fn catalogue() -> Vec<(&'static str, &'static str, &'static [Field])> {
                vec![$((<$group>::TABLE, <$group>::DOC, <$group>::FIELDS)),+]
            }

            /// Sets one by name, whichever table holds it; dashes and underscores are the same.
            pub fn set(&mut self, name: &str, value: &str) -> Result<(), SettingError> {
                let field = name.replace('-', "_");
                $(if self.$field.get(&field).is_some() { return self.$field.set(&field, value); })+
                Err(match renamed(&field) {
                    Some(now) => SettingError::Renamed { name: name.to_owned(), now },
                    None => SettingError::Unknown(name.to_owned()),
                })
            }

            /// The text of one.
            pub fn get(&self, name: &str) -> Option<String> {
                let field = name.replace('-', "_");
                None$(.or_else(|| self.$field.get(&field)))+
            }
        }
    };
}

compose! {
    run: RunSettings,
    scene: SceneSettings,
    poses: PoseSettings,
    vision: VisionSettings,
    train: TrainSettings,
    masks: MaskSettings,
    features: FeatureSettings,
    segment: SegmentSettings,
}

/// Most photos that are worked on at once: each takes memory.
pub(crate) const AT_ONCE: usize = 8;

/// The same for photos that vision services work on.
const MOST_REMOTE: usize = 32;

impl Settings {
    /// Most photos that an actor works on at once beside the training: half of the cores, since the training takes the
    /// others.
    pub(crate) fn most_photos_at_once(&self) -> usize {
        if self.run.photos_at_once > 0 {
            return self.run.photos_at_once as usize;
        }
        let cores = match self.run.threads {
            0 => segwild_flow::all_cores(),
            threads => threads as usize,
        };
        (cores / 2).clamp(1, AT_ONCE)
    }

    /// Works on as many photos at once as vision services take calls, whatever the cores.
    pub(crate) fn allow_remote_calls(&mut self, calls: usize) {
        if calls > 0 && self.run.photos_at_once == 0 {
            self.run.photos_at_once = self.most_photos_at_once().max(calls.min(MOST_REMOTE)) as u32;
        }
    }

    /// The defaults of a preset under a budget.
    pub fn defaults(preset: Preset, budget: RunBudget) -> Settings {
        let mut settings = Settings::preset(preset);
        settings.run.budget = budget;
        if budget == RunBudget::Auto {
            settings.train.appearance_model = AppearanceModel::Auto;
            settings.features.keep_variance = KEEP_VARIANCE;
        }
        settings
    }

    /// The settings with what depends on the scene: the number of steps for its photos. Imported splats leave no budget to find.
    #[must_use]
    pub fn decided(&self, scene: &Scene) -> Settings {
        let mut settings = Settings { train: self.train.decided(scene), ..self.clone() };
        if scene.imported.is_some() {
            settings.run.budget = RunBudget::Fixed;
        }
        settings
    }

    /// Whether the number of steps is left to the scene.
    pub(crate) fn steps_open(&self, scene: &Scene) -> bool {
        self.train.steps == 0 && scene.imported.is_none()
    }

    /// The defaults of a preset.
    pub fn preset(preset: Preset) -> Settings {
        let mut settings = Settings { train: preset.settings(), ..Settings::default() };
        settings.run.preset = preset;
        match preset {
            Preset::Draft => settings.masks.prompt_budget = 128,
            Preset::Standard | Preset::Best => {}
            Preset::Paper => settings.select_as_published(),
        }
        settings
    }

    /// Masks, features and query of the paper (docs/method.md, sections 4 to 7), as far as they are settings.
    fn select_as_published(&mut self) {
        self.masks.prompt_budget = 1024;
        self.masks.min_masks = 0;
        self.features.compression = Compression::Learned;
        self.features.pca_samples = 200_000;
        // By resemblance alone, which takes more steps than the tree does (`PAPER` of segwild-eval).
        self.features.refine_steps = 300;
        self.segment.first_answer = FirstAnswer::Photo;
        self.segment.click_temperature = 1.0;
        self.segment.similarity_use = SimilarityUse::Gate;
        self.segment.evidence_mode = EvidenceMode::Centre;
        self.segment.propagate = 0;
        self.segment.spikes = SpikeMode::Isotropic;
        self.segment.cut_by = CutBy::Prompts;
    }

    /// The protocol by which held-out photos are scored. `aligned`: training photos were aligned to the splats, so that the
    /// poses of others have to be fitted too.
    pub(crate) fn protocol(&self, aligned: bool) -> Protocol {
        match (self.run.scoring, self.train.appearance_model) {
            (Scoring::Auto, _) if aligned => Protocol::Halves,
            (Scoring::Halves, _)
            | (Scoring::Auto, AppearanceModel::Affine | AppearanceModel::Embed | AppearanceModel::Gsw) => {
                Protocol::Halves
            }
            (Scoring::Plain, _) | (Scoring::Auto, AppearanceModel::None | AppearanceModel::Auto) => {
                Protocol::Plain
            }
        }
    }

    /// The same settings with the paths that exist from here made absolute, so that they hold from anywhere.
    pub fn anchored(&self) -> Settings {
        let mut settings = self.clone();
        let Settings { run, scene, vision, .. } = &mut settings;
        let SceneSettings {
            images,
            ignore,
            keep_masks,
            transient_masks,
            split,
            imported_splats,
            imported_frame,
            ..
        } = scene;
        for path in [
            images,
            ignore,
            keep_masks,
            split,
            transient_masks,
            imported_splats,
            imported_frame,
            &mut vision.models,
            &mut vision.transient_network,
            &mut vision.onnxruntime,
            &mut vision.vision_token_file,
            &mut vision.vision_certificates,
            &mut run.lpips_weights,
        ] {
            if !path.is_empty()
                && Path::new(&*path).exists()
                && let Ok(whole) = std::path::absolute(&*path)
            {
                *path = whole.display().to_string();
            }
        }
        settings
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_flag_names_one_setting() {
        let mut seen = BTreeSet::new();
        for (table, _, fields) in Settings::catalogue() {
            for f in fields {
                assert!(seen.insert(f.name), "{} of [{table}] is the second flag of that name", f.name);
            }
        }
    }

    #[test]
    fn half_of_the_cores_work_on_photos_beside_the_training() {
        let photos_at_once = |threads: u32| {
            let mut settings = Settings::default();
            settings.run.threads = threads;
            settings.most_photos_at_once()
        };
        assert_eq!([1, 2, 3, 4, 9, 256].map(photos_at_once), [1, 1, 1, 2, 4, AT_ONCE]);
        assert!((1..=AT_ONCE).contains(&photos_at_once(0)));
        let mut settings = Settings::default();
        settings.allow_remote_calls(0);
        assert_eq!(settings.run.photos_at_once, 0);
        settings.run.threads = 2;
        settings.allow_remote_calls(4);
        assert_eq!(settings.most_photos_at_once(), 4);
        settings.allow_remote_calls(60);
        assert_eq!(settings.most_photos_at_once(), 4, "what is set stays");
    }

    #[test]
    fn paths_hold_from_anywhere() {
        let mut settings = Settings::default();
        settings.vision.models = "src".into();
        settings.scene.images = "inside/the/scene".into();
        let anchored = settings.anchored();
        assert!(Path::new(&anchored.vision.models).is_absolute());
        assert_eq!(anchored.scene.images, "inside/the/scene", "what is not here is looked for in the scene");
    }
}
