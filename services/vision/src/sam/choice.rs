//! Chooses the pair of SAM networks and the device, and writes a note where none can be used.

use super::Sam;
use crate::onnx::{NetworkDevice, Runtime};
use crate::settings::{DeviceChoice, ModelChoice};
use crate::survey::{FileUse, ModelPair, ModelSurvey, SurveyedFile, survey};
use crate::{VisionError, VisionSettings};
use std::path::Path;
use std::sync::Arc;

/// The networks that settings name, or the first that is found; `Err` where they are named and cannot be used. Otherwise a note
/// says why there are none.
pub(crate) fn find_pair(
    settings: &VisionSettings,
    notes: &mut Vec<String>,
) -> Result<Option<Arc<Sam>>, VisionError> {
    let choices = [settings.masks, settings.embedder];
    if choices.iter().all(|&choice| choice == ModelChoice::Builtin) {
        return Ok(None);
    }
    let demanded = choices.contains(&ModelChoice::Sam) || !settings.sam.is_empty();
    match load_first(settings, notes) {
        Ok(found) => Ok(found),
        Err(error) if demanded => Err(error),
        Err(error) => {
            notes.push(format!("SAM: not used: {error}"));
            Ok(None)
        }
    }
}

fn load_first(settings: &VisionSettings, notes: &mut Vec<String>) -> Result<Option<Arc<Sam>>, VisionError> {
    let missing = |what: String| Err(VisionError::Model(what));
    let demanded =
        [settings.masks, settings.embedder].contains(&ModelChoice::Sam) || !settings.sam.is_empty();
    if settings.models.is_empty() {
        return match demanded {
            false => Ok(None),
            true => missing(
                "SAM is requested, but no folder of models is set: set `models` to the folder that holds its encoder \
                 and decoder"
                    .into(),
            ),
        };
    }
    if settings.sam.contains(['/', '\\']) {
        return missing(format!(
            "`sam` is `{}`: it is the stem of names in the folder of models, and no path",
            settings.sam
        ));
    }
    let found = survey(Path::new(&settings.models), &settings.sam)?;
    // A pair that is refused is loaded all the same where there is no other: its error says why.
    let Some(pair) = found.pairs.first().or(found.refused.first()) else {
        return without_pair(settings, &found, demanded, notes);
    };
    let loaded = Runtime::find_within(&settings.onnxruntime, settings.network_memory)
        .and_then(|runtime| load(&runtime, pair, settings, notes));
    let error = loaded.as_ref().err().map(ToString::to_string);
    notes.extend(unused(&found, settings).filter(|words| Some(words) != error.as_ref()).map(not_used));
    let sam = loaded?;
    let mut stems: Vec<&str> = found.files.iter().filter_map(choosable).collect();
    stems.sort_unstable();
    stems.dedup();
    if !stems.is_empty() {
        let others = stems.join(", ");
        notes.push(format!("SAM: {} is taken; there are {others} as well (choose with `sam`)", pair.stem));
    }
    let family = pair.family.map_or(sam.encoder.interface.kind.name(), |f| f.name());
    let licence = pair.family.map_or("ask where the files came from", |f| f.licence());
    notes.push(format!(
        "SAM: {family} `{}` (encoder {}, decoder {}), on {}; licence: {licence}",
        pair.stem,
        sam.encoder.key(),
        sam.decoder.key(),
        if sam.device == NetworkDevice::Cuda { "CUDA" } else { "the CPU" }
    ));
    Ok(Some(Arc::new(sam)))
}

/// The answer where no pair has both of its parts: what is missing or refused, as far as SAM was requested or is there in part.
fn without_pair(
    settings: &VisionSettings,
    found: &ModelSurvey,
    demanded: bool,
    notes: &mut Vec<String>,
) -> Result<Option<Arc<Sam>>, VisionError> {
    let refused = found.files.iter().find_map(|file| match &file.usage {
        FileUse::Refused(reason) => {
            Some(VisionError::Sam { file: file.path.clone(), reason: Box::new(reason.clone()) })
        }
        _ => None,
    });
    let is_half = |file: &&SurveyedFile| matches!(file.usage, FileUse::Alone { .. }) && !file.is_clip();
    let halves: Vec<String> = found.files.iter().filter(is_half).map(words).collect();
    let error = refused.or_else(|| (!halves.is_empty()).then(|| VisionError::Model(halves.join("; "))));
    let shown = error.as_ref().map(ToString::to_string).unwrap_or_default();
    let mut others = unused(found, settings).filter(|words| !shown.contains(words));
    match (error, demanded) {
        (Some(error), _) => {
            notes.extend(others.map(not_used));
            Err(error)
        }
        (None, false) => {
            notes.extend(others.map(not_used));
            Ok(None)
        }
        (None, true) => {
            let stem = if settings.sam.is_empty() { "mobile_sam" } else { &settings.sam };
            let also = others.next().map(|words| format!("; {words}")).unwrap_or_default();
            Err(VisionError::Model(format!(
                "SAM is requested, but {} holds no pair of it: `{stem}_encoder.onnx` and `{stem}_decoder.onnx`, for \
                 instance{also}",
                settings.models
            )))
        }
    }
}

/// A file and what becomes of it, in words.
fn words(file: &SurveyedFile) -> String {
    match &file.usage {
        FileUse::Refused(reason) => format!("{}: {reason}", file.path.display()),
        usage => format!("{} {usage}", file.path.display()),
    }
}

/// Words on each file that nothing uses and that no choice of a pair would use.
fn unused(found: &ModelSurvey, settings: &VisionSettings) -> impl Iterator<Item = String> {
    let elsewhere = Path::new(&settings.transient_network);
    let is_used = move |file: &SurveyedFile| {
        let settled = matches!(file.usage, FileUse::Taken | FileUse::Single | FileUse::Choosable { .. });
        // The notes on queries by text name the files of CLIP.
        settled || file.is_clip() || file.path == elsewhere
    };
    found.files.iter().filter(move |file| !is_used(file)).map(words)
}

fn not_used(words: String) -> String {
    format!("SAM: not used: {words}")
}

/// The stem of another pair.
fn choosable(file: &SurveyedFile) -> Option<&str> {
    match &file.usage {
        FileUse::Choosable { stem } => Some(stem),
        _ => None,
    }
}

fn load(
    runtime: &Runtime,
    pair: &ModelPair,
    settings: &VisionSettings,
    notes: &mut Vec<String>,
) -> Result<Sam, VisionError> {
    let without = || {
        format!(
            "the ONNX Runtime {} was built without CUDA (`pip install onnxruntime-gpu` has it)",
            runtime.library().display()
        )
    };
    match (settings.network_device, runtime.has_cuda()) {
        (DeviceChoice::Cuda, false) => {
            Err(VisionError::Model(format!("`network_device` asks for CUDA, but {}", without())))
        }
        (DeviceChoice::Cuda, true) => Sam::load(runtime, pair, settings, NetworkDevice::Cuda),
        (DeviceChoice::Auto, true) => {
            Sam::load(runtime, pair, settings, NetworkDevice::Cuda).or_else(|error| {
                notes.push(format!("SAM: CUDA cannot be used, so the CPU is: {error}"));
                Sam::load(runtime, pair, settings, NetworkDevice::Cpu)
            })
        }
        (DeviceChoice::Auto | DeviceChoice::Cpu, _) => Sam::load(runtime, pair, settings, NetworkDevice::Cpu),
    }
}
