//! `segwild render`

use super::{path, print_json, print_line};
use crate::failure::Failure;
use clap::ArgMatches;
use segwild_pipeline::{Mode, RenderRequest, RunFolder, What};

/// Draws views.
pub fn render(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path(matches, "run").expect("clap requires it"))?;
    let word = |name: &str| matches.get_one::<String>(name).cloned();
    let mode = match word("mode").as_deref() {
        Some("only") => Mode::Only,
        Some("without") => Mode::Without,
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
        look: word("look"),
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
