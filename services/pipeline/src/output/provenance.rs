//! What exported files say about how they were made.

use crate::{Replay, Settings};
use segwild_scene::Splats;
use serde::Serialize;
use serde_json::Value;

/// How exported objects were made. `.glb` has it in `asset.extras`, COCO files in `info`, archives of masks as `provenance.json`;
/// of a `.ply` a comment of the header has the version and the scene.
#[derive(Clone, Debug, Serialize)]
pub struct ExportProvenance {
    /// Version of segwild.
    pub version: &'static str,
    /// Hash of the scene's splats: equal scenes have the same, whoever made the masks.
    pub scene: String,
    /// Key of the training that the scene is of; `null` where no ledger names it.
    pub training: Option<String>,
    /// The provider of masks: `built-in`, or `sam:` and a model's name.
    pub provider: String,
    /// The settings of the run, without paths of networks and addresses of services.
    pub settings: Settings,
    /// The exported objects; empty where the file is of the scene.
    pub objects: Vec<ObjectProvenance>,
}

/// Settings as others may read them: without the paths and addresses of this machine, which say nothing to them.
pub(crate) fn without_paths(settings: &Settings) -> Settings {
    let mut settings = settings.clone();
    settings.vision.code_mut().into_iter().for_each(String::clear);
    settings.run.lpips_weights.clear();
    let scene = &mut settings.scene;
    let paths = [
        &mut scene.images,
        &mut scene.ignore,
        &mut scene.keep_masks,
        &mut scene.transient_masks,
        &mut scene.split,
        &mut scene.imported_splats,
        &mut scene.imported_frame,
    ];
    // Some of them may have a word in the stead of a path.
    let words = ["none", "auto", "poses"];
    paths.into_iter().filter(|path| !words.contains(&path.as_str())).for_each(String::clear);
    settings
}

/// Numbers that are hashed at a time.
const AT_A_TIME: usize = 1 << 16;

/// The hash of a scene's splats, as 32 hexadecimal digits.
pub(crate) fn scene_digest(splats: &Splats) -> String {
    let mut hasher = blake3::Hasher::new();
    let mut add = |numbers: &[f32]| {
        for some in numbers.chunks(AT_A_TIME) {
            let bytes: Vec<u8> = some.iter().flat_map(|number| number.to_le_bytes()).collect();
            hasher.update(&bytes);
        }
    };
    add(splats.means.as_flattened());
    add(splats.log_scales.as_flattened());
    add(splats.rotations.as_flattened());
    add(&splats.opacities);
    add(&splats.sh);
    hasher.finalize().to_hex()[..32].to_owned()
}

/// How an object was selected.
#[derive(Clone, Debug, Serialize)]
pub struct ObjectProvenance {
    /// Its name.
    pub name: String,
    /// Its prompts and their settings, which select it again unless it was edited; `null` where tools alone selected it.
    pub replay: Option<Replay>,
    /// Whether tools changed it.
    pub edited: bool,
}

impl ExportProvenance {
    /// As JSON.
    pub(crate) fn value(&self) -> Value {
        serde_json::to_value(self).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::SceneSettings;
    use segwild_scene::settings::Field;

    #[test]
    fn no_path_of_a_setting_is_in_an_exported_file() {
        let mut settings = Settings::default();
        let fields = Settings::catalogue().into_iter().flat_map(|(_, _, fields)| fields);
        // Those that take any text: paths, and these names.
        let names = ["adapter", "sam", "object_appearance"];
        let set = |field: &&Field| settings.set(field.name, &format!("/secret/{}", field.name)).is_ok();
        let texts: Vec<&str> = fields.filter(set).map(|field| field.name).collect();
        assert!(
            ["models", "lpips_weights", "images", "split"].iter().all(|path| texts.contains(path)),
            "{texts:?}"
        );
        let kept = serde_json::to_string(&without_paths(&settings)).expect("JSON");
        let exported = |name: &&str| kept.contains(&format!("/secret/{name}\""));
        let exported: Vec<&str> = texts.into_iter().filter(exported).collect();
        assert_eq!(exported.len(), names.len(), "{exported:?}");
        assert!(exported.iter().all(|name| names.contains(name)), "{exported:?}");
        let words = SceneSettings { split: "none".into(), ..SceneSettings::default() };
        let settings = Settings { scene: words.clone(), ..Settings::default() };
        assert_eq!(without_paths(&settings).scene, words);
    }
}
