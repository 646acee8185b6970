//! Chooses the pair of SAM networks and the device, and writes a note where none can be used.

use super::Sam;
use crate::onnx::{NetworkDevice, Runtime};
use crate::registry::{ModelPair, pairs};
use crate::settings::{DeviceChoice, ModelChoice};
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
    let (found, wrong) = pairs(Path::new(&settings.models), &settings.sam);
    let mut found = found.into_iter();
    let Some(pair) = found.next() else {
        return match (wrong.is_empty(), demanded) {
            (false, _) => missing(wrong.join("; ")),
            (true, false) => Ok(None),
            (true, true) => {
                let stem = if settings.sam.is_empty() { "mobile_sam" } else { &settings.sam };
                missing(format!(
                    "SAM is requested, but {} holds no pair of it: `{stem}_encoder.onnx` and `{stem}_decoder.onnx`, for \
                     instance",
                    settings.models
                ))
            }
        };
    };
    notes.extend(wrong.into_iter().map(|w| format!("SAM: not used: {w}")));
    let others: Vec<String> = found.map(|p| p.stem).collect();
    if !others.is_empty() {
        let others = others.join(", ");
        notes.push(format!("SAM: {} is taken; there are {others} as well (choose with `sam`)", pair.stem));
    }
    let runtime = Runtime::find_within(&settings.onnxruntime, settings.network_memory)?;
    let sam = load(&runtime, &pair, settings, notes)?;
    let family = pair.family.map_or("an unknown member of the SAM family", |f| f.name());
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
