//! A scene of a farm: the payload of its job.

use std::collections::BTreeMap;

use segwild_flow::files::name;
use segwild_pipeline::{Settings, Until};
use segwild_scene::settings::Field;
use segwild_vision::VisionSettings;
use serde::{Deserialize, Serialize};

use crate::artefacts::ArtefactDigest;
use crate::job::Job;

/// Settings of free text that name no file: a part of an accelerator's name, and a photo of the scene. All others of free text
/// are taken for paths, new ones as well until they stand here.
const WORDS: [&str; 2] = ["adapter", "object_appearance"];

/// What a worker is to do: nothing but `segwild run` on photos that it fetches, with these settings. A job names no program,
/// no path out of its input, and no setting that names code ([`VisionSettings::CODE`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FarmScene {
    /// The folder of photos and cameras.
    pub photos: ArtefactDigest,
    /// The settings that were given, by name; the others have their preset's defaults.
    pub settings: BTreeMap<String, String>,
    /// Where it stops, as `--until` takes it; absent: at the end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until: Option<String>,
}

/// Why a job is no scene that a worker runs.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FarmSceneError {
    /// Its name is not one of a scene in a batch.
    #[error("`{0}` is not the name of a scene of a farm: BATCH/SCENE, each usable as a file's name")]
    Name(String),
    /// Its payload cannot be read.
    #[error("its job cannot be read: {0}")]
    Payload(String),
    /// What its worker reported at its end cannot be read.
    #[error("its result cannot be read: {0}")]
    Outcome(String),
    /// It has a setting that names code.
    #[error(
        "a farm's scene cannot set `{0}`, which names code or a service: set it where the workers are started"
    )]
    Code(String),
    /// A setting is a path that leads out of the scene's folder.
    #[error(
        "a farm's scene cannot set `{name}` to `{value}`: a farm job's paths lie within its input; give a path relative to the scene's folder, without `..`"
    )]
    Path {
        /// The setting.
        name: String,
        /// Its value, as it is safe to show.
        value: String,
    },
    /// A setting makes no sense.
    #[error("{0}")]
    Settings(String),
}

impl FarmScene {
    /// The scene of a job.
    ///
    /// # Errors
    /// When a worker must not run it.
    pub fn of_job(job: &Job) -> Result<Self, FarmSceneError> {
        parts(&job.id)?;
        let read: Self =
            serde_json::from_str(&job.payload).map_err(|e| FarmSceneError::Payload(e.to_string()))?;
        Self::check(&read.settings, read.until.as_deref())?;
        Ok(read)
    }

    /// Whether a worker runs a scene with these settings, until there.
    ///
    /// # Errors
    /// When it must not.
    pub fn check(settings: &BTreeMap<String, String>, until: Option<&str>) -> Result<(), FarmSceneError> {
        for (name, value) in settings {
            // Settings take dashes as well.
            let field = name.replace('-', "_");
            if VisionSettings::CODE.contains(&field.as_str()) {
                return Err(FarmSceneError::Code(name.clone()));
            }
            if is_path(&field) && !is_within(value) {
                let value = name::one_line(&value.chars().take(120).collect::<String>()).into_owned();
                return Err(FarmSceneError::Path { name: name.clone(), value });
            }
        }
        let wrong = |error: &dyn std::fmt::Display| FarmSceneError::Settings(error.to_string());
        let pairs: Vec<(String, String)> = settings.clone().into_iter().collect();
        Settings::layered(None, &pairs).map_err(|e| wrong(&e))?;
        if let Some(until) = until {
            until.parse::<Until>().map_err(|e| wrong(&e))?;
        }
        Ok(())
    }
}

/// Whether a setting's value is a path, or may be one.
fn is_path(setting: &str) -> bool {
    let text = |field: &Field| field.name == setting && field.kind == "TEXT";
    !WORDS.contains(&setting) && Settings::catalogue().iter().any(|(_, _, fields)| fields.iter().any(text))
}

/// Whether a path stays within the folder that it is relative to, on every system. Nothing and a word such as `none` do.
fn is_within(path: &str) -> bool {
    let parts = path.strip_suffix('/').unwrap_or(path);
    path.is_empty() || (!path.starts_with('~') && !path.contains(':') && parts.split('/').all(name::is_plain))
}

/// The artefact that a scene ended in, by what its worker reported; `None` where it ended in none.
///
/// # Errors
/// When the report cannot be read.
pub(crate) fn artefact_of(outcome: &str) -> Result<Option<ArtefactDigest>, FarmSceneError> {
    let unread = |error: &dyn std::fmt::Display| FarmSceneError::Outcome(error.to_string());
    let outcome: serde_json::Value = serde_json::from_str(outcome).map_err(|e| unread(&e))?;
    outcome["artefact"].as_str().map(str::parse::<ArtefactDigest>).transpose().map_err(|e| unread(&e))
}

/// The batch and the scene that a job's name has.
pub(crate) fn parts(id: &str) -> Result<(&str, &str), FarmSceneError> {
    let usable = |part: &str| name::usable(part).is_ok();
    id.split_once('/')
        .filter(|(batch, scene)| usable(batch) && usable(scene))
        .ok_or_else(|| FarmSceneError::Name(id.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::job::Needs;

    fn read(id: &str, payload: &str) -> Result<FarmScene, FarmSceneError> {
        FarmScene::of_job(&Job::new(id, payload, Needs::default()))
    }

    #[test]
    fn a_job_that_names_code_or_a_path_is_refused() {
        let photos = "ab".repeat(32);
        let payload = |settings: &str| format!("{{\"photos\": \"{photos}\", \"settings\": {settings}}}");
        assert!(read("night/liberty", &payload("{\"steps\": \"300\"}")).is_ok());
        for (id, settings, expected) in [
            ("../liberty", "{}", "not the name of a scene"),
            ("night", "{}", "not the name of a scene"),
            ("night/a/b", "{}", "not the name of a scene"),
            ("night/a", "{\"onnxruntime\": \"/tmp/evil.so\"}", "`onnxruntime`"),
            ("night/a", "{\"vision_service\": \"grpc://evil\"}", "`vision_service`"),
            ("night/a", "{\"vision-service\": \"grpc://evil\"}", "names code or a service"),
            ("night/a", "{\"stpes\": \"3\"}", "no setting named `stpes`"),
        ] {
            let message = read(id, &payload(settings)).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        let outside = "{\"photos\": \"../../etc\", \"settings\": {}}";
        assert!(matches!(read("night/a", outside), Err(FarmSceneError::Payload(_))));
        for until in ["geometri", "0"] {
            let payload = format!("{{\"photos\": \"{photos}\", \"settings\": {{}}, \"until\": \"{until}\"}}");
            assert!(read("night/a", &payload).is_err());
        }
    }

    #[test]
    fn a_job_whose_settings_are_files_outside_of_its_input_is_refused() {
        let check = |name: &str, value: &str| {
            FarmScene::check(&BTreeMap::from([(name.to_owned(), value.to_owned())]), None)
        };
        for name in [
            "images",
            "ignore",
            "keep_masks",
            "transient-masks",
            "split",
            "imported_splats",
            "imported_frame",
            "lpips_weights",
            "sam",
        ] {
            for outside in
                ["/home/other/photos", "../x/images", "a/../../x", "~/x", "C:/x", "C:x", "a\\..\\x", "/"]
            {
                let message = check(name, outside).unwrap_err().to_string();
                assert!(message.contains(name) && message.contains("within its input"), "{message}");
            }
            for inside in ["", "none", "images", "masks/by hand/", "a/b.txt"] {
                check(name, inside).unwrap();
            }
        }
        check("adapter", "Radeon/RX: 7").unwrap();
    }
}
