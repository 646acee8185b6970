//! All settings of a run in one struct: flags, `segwild.toml` and `docs/reference/settings.md` are generated from it.

use segwild_features::FeatureSettings;
use segwild_flow::files;
use segwild_masks::MaskSettings;
use segwild_poses::PoseSettings;
use segwild_scene::settings::{Field, Group, SettingError, Value};
use segwild_scene::{Scene, SceneSettings, choice, settings};
use segwild_segmenter::SegmentSettings;
use segwild_trainer::{AppearanceModel, Preset, Protocol, TrainSettings};
use segwild_vision::VisionSettings;
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

choice! {
    /// The engine that renders and trains the splats.
    pub enum EngineKind {
        /// A hardware GPU if there is one, never software Vulkan; else the CPU.
        Auto = "auto",
        /// The CPU engine.
        Cpu = "cpu",
        /// A hardware GPU, or what `adapter` names; an error without it.
        Gpu = "gpu",
    }
}

choice! {
    /// What happens when the accelerator fails while it computes.
    pub enum WhenLost {
        /// The run stops, and the same command continues it, under `--engine cpu` too.
        Stop = "stop",
        /// The CPU engine takes over.
        Cpu = "cpu",
    }
}

choice! {
    /// What decides the steps, channels and appearance model of a run.
    pub enum RunBudget {
        /// The settings, as they are.
        Fixed = "fixed",
        /// The scene: the least steps, channels and appearance model that suffice, found by short trainings that are
        /// scored on photos held out of them. `steps` is the most that is spent; where it is left to the scene and
        /// photos agree, eight times the scene's own.
        Auto = "auto",
    }
}

choice! {
    /// How held-out photos are scored.
    pub enum Scoring {
        /// `plain` under the appearance model `none`, else `halves`.
        Auto = "auto",
        /// The whole photo, with no appearance fitted to it.
        Plain = "plain",
        /// The appearance fitted on the left half, the right half scored: the official protocol of unconstrained photos.
        Halves = "halves",
    }
}

settings! {
    /// The run as a whole.
    pub struct RunSettings("run", user: preset budget engine threads) {
        /// How much time to spend. It sets the defaults of the other settings.
        preset: Preset = Preset::Standard,
        /// Who decides steps, channels, appearance. What a flag or file sets stays as set.
        budget: RunBudget = RunBudget::Fixed,
        /// Compute threads; 0 takes all cores. The result does not depend on it.
        threads: u32 = 0 => 0..=256,
        /// What computes the splats.
        engine: EngineKind = EngineKind::Cpu,
        /// Part of the accelerator's name, where there are several; empty takes the best. `segwild doctor` lists them.
        adapter: String = String::new(),
        /// What happens when the accelerator fails during the run.
        when_lost: WhenLost = WhenLost::Stop,
        /// How held-out photos are scored.
        scoring: Scoring = Scoring::Auto,
        /// Weights of LPIPS, the perceptual distance, as `.safetensors` (docs/guide/research.md). Held-out photos are scored by it
        /// too, and the loss may have it (`lambda_lpips`). Empty: none.
        lpips_weights: String = String::new(),
        /// Seconds between checkpoints of the training; an interrupted run loses no more than this.
        checkpoint_every: u32 = 30 => 1..,
        /// Most MiB of memory that the run may take; 0 sets no limit. The same holds for an accelerator's own memory.
        /// Caches shrink to fit; what cannot fit is refused before the start.
        memory_budget: u32 = 0,
        /// Photos that masks and descriptors are made of at the same time, beside the training. 0: half of the cores, and as many
        /// as vision services take.
        photos_at_once: u32 = 0 => 0..=64,
        /// Memory in MiB for photos that were decoded, until the next stage reads them.
        photo_memory: u32 = 64,
        /// Checkpoints of the training that are kept; with 2, a damaged one has another to fall back on.
        keep_checkpoints: u32 = 2 => 1..,
        /// Most MiB that the cache keeps when a run ends, oldest first out; 0 keeps all. What this run uses always stays.
        cache_limit: u64 = 0,
        /// Seconds without a sign of life after which a worker is named as stuck.
        stuck_after: u32 = 60 => 1..,
        /// Continue a finished training after transient masks were corrected by hand, for this share of the steps. 0
        /// trains from the start.
        continue_share: f32 = 0.0 => 0.0..=10.0,
        /// Photo pairs shown in the report.
        report_photos: u32 = 8,
    }
}

/// Share of the embedding's variance that is worth channels under `--budget auto`.
const KEEP_VARIANCE: f32 = 0.99;

/// Why settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// The file cannot be read.
    #[error("{file}: cannot be read: {source}")]
    Read {
        /// The file.
        file: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is not what it should be.
    #[error("{file}: {reason}")]
    File {
        /// The file.
        file: PathBuf,
        /// What is wrong in it.
        reason: String,
    },
    /// A value or a name does not fit.
    #[error(transparent)]
    Setting(#[from] SettingError),
}

macro_rules! compose {
    ($($field:ident : $group:ty),+ $(,)?) => {
        /// Every setting of a run; each field is a table of `segwild.toml`.
        #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct Settings { $(#[allow(missing_docs)] pub $field: $group,)+ }

        impl Settings {
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
        if preset == Preset::Draft {
            settings.masks.prompt_budget = 128;
        }
        settings
    }

    /// Defaults of the preset, then the file, then the flags: later wins. Flags are `(name, value)` pairs. A flag that
    /// names another preset or budget than the file also replaces the values that the file has from its own preset or
    /// budget.
    pub fn layered(file: Option<&Path>, flags: &[(String, String)]) -> Result<Settings, SettingsError> {
        let values = match file {
            // A person may name a pipe: `--config <(..)`.
            Some(file) => read_pairs(file, std::fs::read(file))?,
            None => Vec::new(),
        };
        Settings::layered_over(&values, file, flags)
    }

    /// As [`Settings::layered`], from the file of a run folder. The folder may come from somebody else: its paths of code
    /// ([`VisionSettings::CODE`]) are passed over.
    pub fn recorded(file: &Path, flags: &[(String, String)]) -> Result<Settings, SettingsError> {
        let mut values = read_pairs(file, files::read_plain(file))?;
        values.retain(|(name, _)| !VisionSettings::CODE.contains(&name.as_str()));
        Settings::layered_over(&values, Some(file), flags)
    }

    fn layered_over(
        values: &[(String, String)],
        file: Option<&Path>,
        flags: &[(String, String)],
    ) -> Result<Settings, SettingsError> {
        let in_file = |e: SettingError| SettingsError::File {
            file: file.map(Path::to_path_buf).unwrap_or_default(),
            reason: e.to_string(),
        };
        let mut chosen = RunSettings::default();
        let above = |name: &str| name == "preset" || name == "budget";
        for (name, value) in values.iter().filter(|(name, _)| above(name)) {
            chosen.set(name, value).map_err(in_file)?;
        }
        let filed = Settings::defaults(chosen.preset, chosen.budget);
        for (name, value) in flags.iter().filter(|(name, _)| above(name)) {
            chosen.set(name, value)?;
        }
        let mut settings = Settings::defaults(chosen.preset, chosen.budget);
        let as_filed = (chosen.preset, chosen.budget) == (filed.run.preset, filed.run.budget);
        for (name, value) in values {
            let mut probe = filed.clone();
            probe.set(name, value).map_err(in_file)?;
            if as_filed || probe != filed {
                settings.set(name, value).map_err(in_file)?;
            }
        }
        for (name, value) in flags {
            settings.set(name, value)?;
        }
        Ok(settings)
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

    /// As `segwild.toml`, each setting with its documentation above it.
    pub fn to_toml(&self) -> String {
        let mut text = String::new();
        for (table, doc, fields) in Settings::catalogue() {
            let _ = write!(text, "# {doc}\n[{table}]\n");
            for field in fields {
                let value = self.get(field.name).unwrap_or_default();
                let quoted = if field.kind == "N" || field.kind == "X" || field.choices == ["true", "false"] {
                    value
                } else {
                    toml::Value::String(value).to_string()
                };
                let _ = writeln!(text, "# {}", field.doc);
                for (word, doc) in field.explained_choices() {
                    let _ = writeln!(text, "#   {word}: {doc}");
                }
                let _ = writeln!(text, "{} = {quoted}", field.name);
            }
            text.push('\n');
        }
        text
    }

    /// A page of the reference, one table per group: the settings that a user needs, or those for experts.
    pub fn to_markdown(expert: bool) -> String {
        let mut text = String::from(if expert { EXPERT_PAGE } else { USER_PAGE });
        for (table, doc, fields) in Settings::catalogue() {
            let rows: Vec<String> = fields.iter().filter(|f| f.expert == expert).map(row).collect();
            if !rows.is_empty() {
                let head = "| flag | default | meaning |\n|---|---|---|\n";
                let _ = write!(text, "\n## `[{table}]`\n\n{doc}\n\n{head}{}", rows.concat());
            }
        }
        if !expert {
            text += &presets();
        }
        text
    }
}

/// The section of the reference on what each preset sets: the settings that are not the same under all of them.
fn presets() -> String {
    let words = Preset::CHOICES;
    let defaults: Vec<Settings> =
        words.iter().filter_map(|word| Preset::read(word).ok()).map(Settings::preset).collect();
    let mut text = format!(
        "\n## Presets\n\nWhat `--preset` sets. The defaults of all other settings do not depend on it.\n\n| flag | {} |\n|---|{}\n",
        words.join(" | "),
        "---:|".repeat(words.len())
    );
    for field in Settings::catalogue().into_iter().flat_map(|(_, _, fields)| fields) {
        let values: Vec<String> = defaults.iter().filter_map(|settings| settings.get(field.name)).collect();
        if field.name != "preset" && values.iter().any(|value| *value != values[0]) {
            let _ = writeln!(text, "| `--{}` | {} |", field.name.replace('_', "-"), values.join(" | "));
        }
    }
    text
}

/// Head of the reference's first page.
const USER_PAGE: &str = "# Settings\n\nThese are the settings that a user needs; [all others](expert-settings.md) are for \
    experts. Every setting is a flag (`--name value`) and a line of `segwild.toml`. Flags win over the file, the file wins over \
    the preset. This page is generated: `segwild doctor --settings user`.\n";

/// Head of its second page.
const EXPERT_PAGE: &str = "# Expert settings\n\nFew scenes need these; [the others](settings.md) come first. `--help-all` \
    lists them beside the flags of a command. This page is generated: `segwild doctor --settings expert`.\n";

/// The row of a setting on a page of the reference. Each word of a choice has a line of its own.
fn row(field: &Field) -> String {
    let explained: String =
        field.explained_choices().map(|(word, doc)| format!("<br>`{word}`: {doc}")).collect();
    let choices = match field.range {
        Some(range) => format!(" ({})", range()),
        None if field.choices.is_empty() || !explained.is_empty() => explained,
        None => format!(" ({})", field.choices.join(", ")),
    };
    let default = match Settings::default().get(field.name).unwrap_or_default() {
        none if none.is_empty() => "*none*".to_owned(),
        default => format!("`{default}`"),
    };
    format!("| `--{}` | {default} | {}{choices} |\n", field.name.replace('_', "-"), field.doc)
}

/// Settings of earlier versions, and what they are called now.
const RENAMED: [(&str, &str); 8] = [
    ("look", "appearance_model"),
    ("lr_look", "lr_appearance"),
    ("lr_code", "lr_splat_embedding"),
    ("codes_from", "splat_embedding_from"),
    ("strangers", "transient_masks"),
    ("strangers_network", "transient_network"),
    ("train_on", "continue_share"),
    ("object_look", "object_appearance"),
];

/// Settings of earlier versions that are gone, each with the value at which it did what is always done now. Run folders have
/// every setting in their file.
const REMOVED: [(&str, &str); 3] =
    [("seen", "0"), ("centre_visible", "false"), ("graph_cut_smoothness", "1")];

/// Whether a setting is gone and has the value at which it did what is always done now.
pub(crate) fn is_removed(name: &str, value: &str) -> bool {
    REMOVED.contains(&(name, value.trim_end_matches(".0")))
}

/// What a setting of an earlier version is called now; dashes and underscores are the same.
pub fn renamed(name: &str) -> Option<&'static str> {
    let name = name.replace('-', "_");
    RENAMED.iter().find(|(before, _)| *before == name).map(|(_, now)| *now)
}

/// A settings file as `(name, value)` pairs; the table of each must be the one it belongs to.
fn read_pairs(file: &Path, read: std::io::Result<Vec<u8>>) -> Result<Vec<(String, String)>, SettingsError> {
    let wrong = |reason: String| SettingsError::File { file: file.to_path_buf(), reason };
    let bytes = read.map_err(|source| SettingsError::Read { file: file.to_path_buf(), source })?;
    let text = segwild_scene::text::decode(bytes).map_err(|e| wrong(e.to_string()))?;
    let tables: toml::Table = text.parse().map_err(|e: toml::de::Error| wrong(e.to_string()))?;
    let catalogue = Settings::catalogue();
    let mut pairs = Vec::new();
    for (table, content) in &tables {
        let Some((_, _, fields)) = catalogue.iter().find(|(name, _, _)| name == table) else {
            return Err(wrong(format!("there is no table [{table}]")));
        };
        let Some(content) = content.as_table() else {
            return Err(wrong(format!("`{table}` must be a table: [{table}]")));
        };
        for (name, value) in content {
            let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            if is_removed(name, &value) {
                continue;
            }
            if !fields.iter().any(|f| f.name == name) {
                let now = renamed(name).map_or(String::new(), |now| format!("; it is now `{now}`"));
                return Err(wrong(format!("[{table}] has no setting `{name}`{now}")));
            }
            pairs.push((name.clone(), value));
        }
    }
    Ok(pairs)
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
    fn every_word_of_a_choice_is_explained() {
        for field in Settings::catalogue().into_iter().flat_map(|(_, _, fields)| fields) {
            if field.choices != bool::CHOICES {
                assert_eq!(field.choices.len(), field.choice_docs.len(), "{}", field.name);
            }
            let one_line = |doc: &&str| doc.ends_with('.') && !doc.contains(['|', '\n']);
            assert!(field.choice_docs.iter().all(one_line), "{}: {:?}", field.name, field.choice_docs);
        }
        let page = Settings::to_markdown(false);
        assert!(page.contains("How spikes are cut.<br>`axis`: Shrunk along the direction"), "{page}");
        assert!(Settings::default().to_toml().contains("#   off: Not cut.\nspikes = \"axis\"\n"));
    }

    #[test]
    fn the_reference_names_what_each_preset_sets() {
        let page = Settings::to_markdown(false);
        let (_, section) = page.split_once("## Presets").unwrap();
        assert!(section.contains("| flag | draft | standard | best |"), "{section}");
        for row in ["| `--effort` | 0.5 | 1 | 1.5 |", "| `--sh-degree` | 1 | 2 | 3 |"] {
            assert!(section.contains(row), "{section}");
        }
        assert!(!section.contains("`--seed`"), "{section}");
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
    fn file_and_flags_are_layered_over_the_preset() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        std::fs::write(&file, "[run]\npreset = \"draft\"\n[segment]\ntau = 0.4\n").unwrap();
        let flags = [("tau".to_owned(), "0.3".to_owned())];
        let settings = Settings::layered(Some(&file), &flags).unwrap();
        assert_eq!(settings.run.preset, Preset::Draft);
        assert_eq!(settings.train, Settings::preset(Preset::Draft).train);
        assert_eq!(settings.segment.tau, 0.3);
    }

    #[test]
    fn a_settings_file_that_a_windows_editor_saved_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        std::fs::write(&file, "\u{feff}[segment]\r\ntau = 0.4\r\n").unwrap();
        assert_eq!(Settings::layered(Some(&file), &[]).unwrap().segment.tau, 0.4);
        std::fs::write(&file, b"[\0s\0]\0").unwrap();
        let refused = Settings::layered(Some(&file), &[]).unwrap_err().to_string();
        assert!(refused.contains("segwild.toml") && refused.contains("UTF-16"), "{refused}");
    }

    #[test]
    fn another_preset_is_obeyed_in_a_folder_that_remembers_all_settings() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        let mut draft = Settings::preset(Preset::Draft);
        draft.set("tau", "0.4").unwrap();
        std::fs::write(&file, draft.to_toml()).unwrap();
        let flags = [("preset".to_owned(), "best".to_owned())];
        let mut best = Settings::preset(Preset::Best);
        best.set("tau", "0.4").unwrap();
        assert_eq!(Settings::layered(Some(&file), &flags).unwrap(), best);
        assert_eq!(Settings::layered(Some(&file), &[]).unwrap(), draft);
    }

    #[test]
    fn a_run_folder_names_no_code() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        let mut sent = Settings::default();
        for name in VisionSettings::CODE {
            sent.set(name, "/tmp/theirs").unwrap();
        }
        sent.set("tau", "0.4").unwrap();
        std::fs::write(&file, sent.to_toml()).unwrap();
        let settings = Settings::recorded(&file, &[]).unwrap();
        assert!(!settings.to_toml().contains("/tmp/theirs"));
        assert_eq!(settings.segment.tau, 0.4);
        let flags = [("models".to_owned(), "/mine".to_owned())];
        assert_eq!(Settings::recorded(&file, &flags).unwrap().vision.models, "/mine");
    }

    #[test]
    fn what_is_written_reads_back_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        for preset in [Preset::Draft, Preset::Standard, Preset::Best] {
            let settings = Settings::preset(preset);
            std::fs::write(&file, settings.to_toml()).unwrap();
            assert_eq!(Settings::layered(Some(&file), &[]).unwrap(), settings);
        }
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

    #[test]
    fn the_settings_of_a_run_from_before_some_of_them_were_removed_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        std::fs::write(
            &file,
            "[segment]\nseen = 0\ncentre_visible = false\ngraph_cut_smoothness = 1.0\ntau = 0.4\n",
        )
        .unwrap();
        assert_eq!(Settings::layered(Some(&file), &[]).unwrap().segment.tau, 0.4);
        std::fs::write(&file, "[segment]\nseen = 0.1\n").unwrap();
        let refused = Settings::layered(Some(&file), &[]).unwrap_err().to_string();
        assert!(refused.contains("has no setting `seen`"), "{refused}");
    }

    #[test]
    fn mistakes_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("segwild.toml");
        for (text, words) in [
            ("[segment]\ntua = 0.4\n", "[segment] has no setting `tua`"),
            ("[sgement]\n", "there is no table [sgement]"),
            ("[segment]\ntau = \"much\"\n", "`much` does not fit `tau`"),
            ("[train]\neffort = 0\n", "expected 0.01 to 100"),
            ("[segment]\ntau = 7\n", "expected -1 to 1"),
            ("[segment\n", "segwild.toml"),
        ] {
            std::fs::write(&file, text).unwrap();
            let message = Settings::layered(Some(&file), &[]).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
    }
}
