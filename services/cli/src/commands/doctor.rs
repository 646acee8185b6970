//! `segwild doctor`

use super::{path, print_json, print_line};
use crate::failure::Failure;
use clap::ArgMatches;
use segwild_pipeline::Settings;
use segwild_vision::{Providers, Runtime, VisionSettings};

/// Says what this machine offers and what is used instead of what is missing.
pub fn doctor(matches: &ArgMatches) -> Result<(), Failure> {
    if matches.get_flag("settings") {
        return print_line(Settings::to_markdown().trim_end());
    }
    let mut found: Vec<(&str, String)> = Vec::new();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    found.push(("cores", cores.to_string()));
    found.push(("splat kernels", format!("CPU, {:?}", segwild_raster::CpuEngine::default().isa())));
    found.push((
        "ONNX Runtime",
        match Runtime::find("") {
            Ok(runtime) => runtime.library().display().to_string(),
            Err(error) => format!("not usable: {error}. The built-in provider needs none."),
        },
    ));
    let models = path(matches, "models");
    let settings = VisionSettings {
        models: models.map_or(String::new(), |p| p.display().to_string()),
        ..VisionSettings::default()
    };
    match Providers::from_settings(&settings) {
        Ok(providers) => found.extend(providers.notes.into_iter().map(|note| ("seeing", note))),
        Err(error) => found.push(("seeing", error.to_string())),
    }
    if matches.get_flag("json") {
        let list: Vec<_> =
            found.iter().map(|(what, is)| serde_json::json!({ "what": what, "is": is })).collect();
        return print_json(&list);
    }
    for (what, is) in found {
        print_line(&format!("{what:>14}  {is}"))?;
    }
    Ok(())
}
