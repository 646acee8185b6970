//! `segwild bake`

use super::render::{appearance, object_appearance};
use super::{path, print_json, print_line};
use crate::failure::Failure;
use clap::ArgMatches;
use segwild_pipeline::{BakeRequest, Part, RunFolder};

/// Writes splats under a look.
pub fn bake(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path(matches, "run").expect("clap requires it"))?;
    let word = |name: &str| matches.get_one::<String>(name).cloned();
    let (selection, object_appearance) = (word("selection"), object_appearance(matches));
    let part = match word("mode").as_deref() {
        Some("only") => Part::Only,
        Some("without") => Part::Without,
        None if selection.is_some() && object_appearance.is_none() => Part::Only,
        _ => Part::Scene,
    };
    let request = BakeRequest {
        appearance: appearance(matches, "appearance", "strength"),
        object_appearance,
        between: matches.get_one::<f32>("interpolate").copied(),
        selection,
        part,
        out: path(matches, "out").unwrap_or_else(|| folder.path().join("baked.ply")),
    };
    let baked = segwild_pipeline::bake(&folder, &request)?;
    if matches.get_flag("json") {
        return print_json(&baked);
    }
    print_line(&format!("{} splats: {}", baked.splats, baked.file.display()))
}
