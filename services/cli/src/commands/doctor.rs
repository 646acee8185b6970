//! `segwild doctor`

use crate::args::{self, examples, flag, json, path_of};
use crate::exit;
use crate::failure::Failure;
use crate::output::{print_json, print_line};
use clap::{Arg, ArgMatches, Command};
use segwild_gpu::{Adapter, AdapterChoice, GpuEngine};
use segwild_pipeline::{RunSettings, Settings, SplatTransform, choose_engine};
use segwild_poses::{Colmap, Ffmpeg, Glomap};
use segwild_selftest::check;
use segwild_vision::{FileUse, ModelFile, Providers, Runtime, VisionSettings, models_in};
use std::path::PathBuf;

/// The command's arguments.
pub fn command() -> Command {
    Command::new("doctor")
        .about("Print what this machine offers, and what replaces what is missing")
        .arg(
            Arg::new("settings")
                .long("settings")
                .value_name("WORD")
                .value_parser(["user", "expert"])
                .num_args(0..=1)
                .default_missing_value("user")
                .help("Print a page of the settings' reference"),
        )
        .arg(flag("commands", "Print the page of all commands"))
        .arg(flag("openapi", "Print the requests of the studio as an OpenAPI document"))
        .arg(args::path("models", "Folder of network files to inspect"))
        .arg(
            Arg::new("kernels")
                .long("kernels")
                .value_name("ADAPTER")
                .num_args(0..=1)
                .default_missing_value("")
                .help("Compare every kernel of an accelerator with the CPU engine [default: the best accelerator]"),
        )
        .arg(json())
        .after_help(examples("segwild doctor", "segwild doctor --models models --json"))
}

/// Says what this machine offers and what is used instead of what is missing, or prints a page of the reference to the
/// program.
pub fn doctor(matches: &ArgMatches, program: Command) -> Result<(), Failure> {
    if let Some(page) = matches.get_one::<String>("settings") {
        return print_line(Settings::to_markdown(page == "expert").trim_end());
    }
    if matches.get_flag("commands") {
        return print_line(super::reference::markdown(program).trim_end());
    }
    if matches.get_flag("openapi") {
        return print_line(&format!("{:#}", segwild_studio::openapi()));
    }
    if let Some(adapter) = matches.get_one::<String>("kernels") {
        return kernels(adapter, matches.get_flag("json"));
    }
    let mut found: Vec<(&str, String)> = Vec::new();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    found.push(("cores", cores.to_string()));
    let adapters = segwild_gpu::adapters();
    if adapters.is_empty() {
        found.push(("accelerator", format!("none: {}", segwild_gpu::NO_DRIVER)));
    }
    found.extend(adapters.iter().map(|adapter| ("accelerator", accelerator(adapter))));
    found.push((
        "splats",
        match choose_engine(&RunSettings::default(), drop) {
            Ok(chosen) => format!("computed by {} (`--engine`, `--adapter`)", chosen.why),
            Err(error) => error.to_string(),
        },
    ));
    found.push((
        "ONNX Runtime",
        match Runtime::find("") {
            Ok(runtime) => {
                let cuda = if runtime.has_cuda() { "with CUDA" } else { "CPU only" };
                format!("{} ({cuda})", runtime.library().display())
            }
            Err(error) => format!("not usable: {error}. The built-in provider needs none."),
        },
    ));
    let colmap = Colmap::find();
    found.push((
        "poses",
        colmap.as_ref().map_or_else(
            || "no COLMAP on the PATH: photos need poses of their own (Debian, Ubuntu: apt-get install colmap)".into(),
            |colmap| format!("{} ({})", colmap.version, if colmap.has_cuda { "with CUDA" } else { "CPU only" }),
        ),
    ));
    found.push((
        "poses at once",
        Glomap::find(colmap.as_ref()).map_or_else(
            || "no GLOMAP: COLMAP has no global_mapper, no glomap on the PATH; `--mapper` is colmap".into(),
            |glomap| format!("{} (`--mapper`)", glomap.version),
        ),
    ));
    found.push((
        "video",
        Ffmpeg::find().map_or_else(
            || {
                "no ffmpeg on the PATH: no photos out of videos, no .mp4 (Debian, Ubuntu: apt-get install ffmpeg)"
                    .into()
            },
            |ffmpeg| ffmpeg.version,
        ),
    ));
    found.push((
        "exports",
        SplatTransform::find().map_or_else(
            || {
                "no splat-transform on the PATH: no .sog, .compressed.ply and .html (npm install -g \
                 @playcanvas/splat-transform)"
                    .into()
            },
            |found| found.version,
        ),
    ));
    let named = || std::env::var_os("SEGWILD_MODELS").filter(|named| !named.is_empty());
    let models = path_of(matches, "models").or_else(|| named().map(PathBuf::from));
    match &models {
        None => {
            found.push(("networks", "no folder of models is given (`--models`, or SEGWILD_MODELS)".into()))
        }
        Some(folder) => match models_in(folder) {
            Ok(files) if files.is_empty() => {
                found.push(("networks", format!("{} holds no .onnx file", folder.display())));
            }
            Ok(files) => found.extend(files.iter().map(|file| ("network", described(file)))),
            Err(error) => found.push(("networks", error.to_string())),
        },
    }
    let settings = VisionSettings {
        models: models.map_or(String::new(), |p| p.display().to_string()),
        ..VisionSettings::default()
    };
    match Providers::from_settings(&settings) {
        Ok(providers) => found.extend(providers.notes.into_iter().map(|note| ("seeing", note))),
        Err(error) => found.push(("seeing", error.to_string())),
    }
    if matches.get_flag("json") {
        return found
            .iter()
            .try_for_each(|(what, is)| print_json(&serde_json::json!({ "what": what, "is": is })));
    }
    for (what, is) in found {
        print_line(&format!("{what:>14}  {is}"))?;
    }
    Ok(())
}

/// Compares every kernel on an accelerator with the CPU engine.
fn kernels(adapter: &str, json: bool) -> Result<(), Failure> {
    let best = || segwild_gpu::adapters().into_iter().next().map(|adapter| adapter.name);
    let named = if adapter.is_empty() { best() } else { Some(adapter.to_owned()) };
    let choice = named.map_or(AdapterChoice::Hardware, AdapterChoice::Named);
    let engine =
        GpuEngine::new(&choice).map_err(|e| Failure { message: e.to_string(), code: exit::INPUT })?;
    let name = &engine.adapter().name;
    let checked = check(&engine).map_err(|e| Failure { message: e.to_string(), code: exit::FAILED })?;
    for step in &checked {
        let (names, off) = (step.kernels.join(", "), step.off.as_ref().map(ToString::to_string));
        match json {
            true => print_json(&serde_json::json!({ "kernels": step.kernels, "off": off }))?,
            false => print_line(&format!("{names:>26}  {}", off.as_deref().unwrap_or("as on the CPU")))?,
        }
    }
    match checked.iter().find(|step| step.off.is_some()) {
        None => Ok(()),
        Some(first) => Err(Failure {
            message: format!(
                "{name} computes otherwise than the CPU, first in {}: use --engine cpu, and report this with the driver's \
                 version",
                first.kernels.join(", ")
            ),
            code: exit::FAILED,
        }),
    }
}

/// An accelerator in one line: what it is, and its limits.
fn accelerator(adapter: &Adapter) -> String {
    let Adapter { name, backend, kind, driver, binding, shared, subgroups } = adapter;
    let (binding, shared) = (binding >> 20, shared >> 10);
    let subgroups = match subgroups {
        Some((least, most)) if least == most => format!("sums and sorts by subgroups of {least} threads"),
        Some((least, most)) => format!("sums and sorts by subgroups of {least} to {most} threads"),
        None => "no subgroups".to_owned(),
    };
    format!(
        "{name}: {kind}, {backend}, {driver}; arrays of {binding} MiB, {shared} KiB shared by a group; {subgroups}"
    )
}

/// A network file in one line: what it is by its name and by its inputs and outputs, how large, its hash, its terms, and what a run
/// makes of it.
fn described(file: &ModelFile) -> String {
    let what = match (file.family, file.role) {
        (Some(family), Some(role)) => format!("{}, {role}", family.name()),
        (None, Some(role)) => format!("{role} of an unknown family"),
        _ => "a name that is not known".into(),
    };
    let interface = file.interface.map(|kind| format!(", inputs and outputs of {kind}")).unwrap_or_default();
    let licence = file.family.map_or("not known: ask where it came from", |f| f.licence());
    let mb = file.bytes as f64 / 1e6;
    let usage = match &file.usage {
        FileUse::Refused(_) | FileUse::RefusedClip(_) => format!("refused: {}", file.usage),
        usage => format!("it {usage}"),
    };
    match &file.hash {
        Ok(hash) => format!(
            "{}: {what}{interface}, {mb:.1} MB, BLAKE3 {hash}, licence: {licence}; {usage}",
            file.name
        ),
        Err(reason) => format!("{}: {what}, cannot be used: {reason}", file.name),
    }
}
