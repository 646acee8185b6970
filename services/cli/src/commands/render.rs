//! `segwild render`

use super::{path, print_json, print_line};
use crate::failure::Failure;
use clap::ArgMatches;
use segwild_pipeline::{LookRequest, Mode, RenderRequest, RunFolder, What};

/// Draws views.
pub fn render(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path(matches, "run").expect("clap requires it"))?;
    let word = |name: &str| matches.get_one::<String>(name).cloned();
    let object_look = object_look(matches);
    let mode = match word("mode").as_deref() {
        Some("only") => Mode::Only,
        Some("without") => Mode::Without,
        Some("scene") => Mode::Scene,
        None if object_look.is_some() => Mode::Scene,
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
        look: look(matches, "look", "strength"),
        object_look,
        between: matches.get_one::<f32>("between").copied(),
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
pub fn look(matches: &ArgMatches, flag: &str, strength: &str) -> LookRequest {
    LookRequest {
        photos: matches.get_many::<String>(flag).into_iter().flatten().cloned().collect(),
        strength: matches.get_one::<f32>(strength).copied().unwrap_or(1.0),
    }
}

/// The looks of the selected object, if it has its own.
pub fn object_look(matches: &ArgMatches) -> Option<LookRequest> {
    Some(look(matches, "object-look", "object-strength")).filter(|look| !look.photos.is_empty())
}
