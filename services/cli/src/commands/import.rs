//! `segwild import`

use super::run::{run_scene, settings, tell};
use crate::args::{self, examples, json, path_of, until, with_settings_in_long_help};
use crate::failure::Failure;
use crate::output::{print_json, print_line};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_flow::Stopper;
use segwild_pipeline::{RunError, RunFolder, Until, render_views};
use segwild_scene::SplatFile;
use std::path::{Path, PathBuf};

/// The command's arguments.
pub fn command() -> Command {
    let splats =
        Arg::new("file").value_name("SPLATS").required(true).value_parser(value_parser!(PathBuf)).help(
            "File of splats: .ply, .compressed.ply, .splat, .spz, .glb, .sog; or a folder of 3D Gaussian Splatting",
        );
    with_settings_in_long_help(
        Command::new("import")
            .about("Make a run of splats that another program trained: masks, objects, clicks, exports"),
    )
    .arg(splats)
    .arg(args::path("photos", "The photos with their poses, as for `run` [default: views are rendered]"))
    .args(args::run_files())
    .arg(until("Stop after this stage; a later one goes on from there"))
    .arg(json())
    .after_help(examples(
        "segwild import output/garden/point_cloud/iteration_30000/point_cloud.ply --photos garden",
        "segwild import statue.spz --out runs/statue",
    ))
}

/// Makes the run, or what is left of it.
pub fn import(matches: &ArgMatches) -> Result<(), Failure> {
    let named = path_of(matches, "file").expect("clap requires it");
    let file = SplatFile::open(&named).map_err(RunError::from)?;
    let out = path_of(matches, "out").unwrap_or_else(|| default_folder(&file.path));
    let mut settings = settings(matches, &RunFolder::at(&out))?;
    let whole = std::path::absolute(&file.path).unwrap_or_else(|_| file.path.clone());
    settings.scene.imported_splats = whole.display().to_string();
    let json = matches.get_flag("json");
    let scene = match path_of(matches, "photos") {
        Some(photos) => {
            // A damaged file is refused before anything is computed; the run reads it again.
            file.read().map_err(RunError::from)?;
            photos
        }
        None => {
            if !json {
                print_line(&format!("{}: rendering views of {} splats", file.path.display(), file.splats))?;
            }
            render_views(&file, &RunFolder::create(&out)?, &mut settings)?
        }
    };
    let until = matches.get_one::<Until>("until").copied();
    let summary = run_scene(&scene, &out, &settings, until, json, Stopper::new())?;
    if json {
        return print_json(&serde_json::json!({ "event": "summary", "folder": out, "summary": summary }));
    }
    tell(&summary, &out)
}

/// `runs/NAME` for a file of that name. Programs call all their files `point_cloud.ply`: there the folder that they trained into
/// has the name.
fn default_folder(file: &Path) -> PathBuf {
    let stem =
        |path: &Path| path.file_name().and_then(|name| name.to_str()?.split('.').next().map(str::to_owned));
    let general = |name: &str| {
        ["point_cloud", "splat", "splats", "scene", "ply"].contains(&name) || name.starts_with("iteration_")
    };
    let whole = std::path::absolute(file).unwrap_or_else(|_| file.to_owned());
    let named = whole.ancestors().filter_map(stem).find(|name| !general(name));
    Path::new("runs").join(named.unwrap_or_else(|| "splats".to_owned()))
}
