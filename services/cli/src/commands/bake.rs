//! `segwild bake`

use super::render::{appearance, object_appearance};
use crate::args::{self, appearances, choice, examples, json, path_of, selection, under};
use crate::failure::Failure;
use crate::output::{print_json, print_line};
use crate::progress::stop_on_ctrl_c;
use clap::{ArgMatches, Command};
use segwild_flow::Stopper;
use segwild_pipeline::{BakeRequest, RunFolder, ScenePart};

/// The command's arguments.
pub fn command() -> Command {
    let selected = [
        selection("The selection to write"),
        choice(
            "mode",
            ["only", "without", "scene"],
            "What is written [default: only with --selection; scene otherwise, and with --object-appearance]",
        ),
    ];
    let output = [
        args::path(
            "out",
            "The file: .ply, .spz, .glb; .compressed.ply, .sog, .html by splat-transform [default: RUN/baked.ply]",
        ),
        json(),
    ];
    Command::new("bake")
        .about("Write splats with an appearance for any viewer: the scene or a selection")
        .arg(args::run())
        .args(appearances("scene's own"))
        .args(under("Selection", selected))
        .args(under("Output", output))
        .after_help(examples(
            "segwild bake runs/trevi --appearance sunset.jpg --out trevi.ply",
            "segwild bake runs/trevi --selection oceanus --appearance none --out oceanus.spz",
        ))
}

/// Writes splats with an appearance.
pub fn bake(matches: &ArgMatches) -> Result<(), Failure> {
    let folder = RunFolder::open(&path_of(matches, "run").expect("clap requires it"))?;
    let word = |name: &str| matches.get_one::<String>(name).cloned();
    let (selection, object_appearance) = (word("selection"), object_appearance(matches));
    let part = match word("mode").as_deref() {
        Some("only") => ScenePart::Only,
        Some("without") => ScenePart::Without,
        None if selection.is_some() && object_appearance.is_none() => ScenePart::Only,
        _ => ScenePart::Scene,
    };
    let request = BakeRequest {
        appearance: appearance(matches),
        object_appearance,
        interpolate: matches.get_one::<f32>("interpolate").copied(),
        selection,
        part,
        out: path_of(matches, "out").unwrap_or_else(|| folder.path().join("baked.ply")),
    };
    let stopper = Stopper::new();
    stop_on_ctrl_c(&stopper)?;
    let baked = segwild_pipeline::bake(&folder, &request, &stopper)?;
    if matches.get_flag("json") {
        return print_json(&baked);
    }
    print_line(&format!("{} splats: {}", baked.splats, baked.file.display()))?;
    match baked.unseen.filter(|share| *share > 0.0) {
        Some(share) => print_line(&format!(
            "{:.1} % of what `{}` covers in the photos no photo saw: there are holes",
            100.0 * share,
            word("selection").unwrap_or_default()
        )),
        None => Ok(()),
    }
}
