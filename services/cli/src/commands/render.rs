//! `segwild render`

use super::{path, print_json, print_line};
use crate::failure::Failure;
use clap::ArgMatches;
use segwild_pipeline::{AppearanceRequest, Mode, RenderRequest, RunFolder, What};

/// Draws views.
pub fn render(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path(matches, "run").expect("clap requires it"))?;
    let word = |name: &str| matches.get_one::<String>(name).cloned();
    let object_appearance = object_appearance(matches);
    let mode = match word("mode").as_deref() {
        Some("only") => Mode::Only,
        Some("without") => Mode::Without,
        Some("scene") => Mode::Scene,
        None if object_appearance.is_some() => Mode::Scene,
        _ => Mode::Highlight,
    };
    let what = match word("what").as_deref() {
        Some("depth") => What::Depth,
        Some("alpha") => What::Alpha,
        Some("features") => What::Features,
        _ => What::Colour,
    };
    let request = RenderRequest {
        photos: matches.get_many::<String>("photo").into_iter().flatten().cloned().collect(),
        frames: matches.get_one::<u32>("frames").copied(),
        appearance: appearance(matches, "appearance", "strength"),
        object_appearance,
        between: matches.get_one::<f32>("interpolate").copied(),
        selection: word("selection").map(|name| (name, mode)),
        what,
        width: matches.get_one::<u32>("width").copied(),
        out: path(matches, "out"),
    };
    for drawn in segwild_pipeline::render(&folder, &request)? {
        if matches.get_flag("json") {
            print_json(&drawn)?;
        } else {
            print_line(&drawn.file.display().to_string())?;
        }
    }
    Ok(())
}

/// The looks that a flag names.
pub fn appearance(matches: &ArgMatches, flag: &str, strength: &str) -> AppearanceRequest {
    AppearanceRequest {
        photos: matches.get_many::<String>(flag).into_iter().flatten().cloned().collect(),
        strength: matches.get_one::<f32>(strength).copied().unwrap_or(1.0),
    }
}

/// The looks of the selected object, if it has its own.
pub fn object_appearance(matches: &ArgMatches) -> Option<AppearanceRequest> {
    Some(appearance(matches, "object-appearance", "object-strength"))
        .filter(|appearance| !appearance.photos.is_empty())
}
