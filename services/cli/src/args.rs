//! The command line, made from the settings structs and from what is particular to each command.

use crate::operators::{child_args, listen_args};
use clap::builder::PossibleValuesParser;
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use segwild_pipeline::Settings;
use std::path::PathBuf;

/// The whole program.
pub fn program() -> Command {
    Command::new("segwild")
        .version(env!("CARGO_PKG_VERSION"))
        .about("From a pile of tourist photos to a 3D scene whose objects you can click")
        .subcommand_required(true)
        .arg_required_else_help(true)
        .after_help(crate::exit::HELP)
        .arg(
            // For tests: what goes wrong where, as `segwild_flow::fault` reads it.
            Arg::new("fault").long("fault").global(true).hide(true).action(ArgAction::Append),
        )
        .subcommand(
            child_args(listen_args(with_settings(
                Command::new("run").about("Train a scene: geometry, looks, masks, features, report"),
            )))
            .arg(
                Arg::new("scene")
                    .required(true)
                    .value_parser(value_parser!(PathBuf))
                    .help("COLMAP folder, Photo Tourism folder, or folder with transforms.json"),
            )
            .arg(path("out", "Run folder [default: runs/NAME]"))
            .arg(path("config", "Settings file [default: segwild.toml in the run folder, if there]"))
            .arg(until("Stop after this stage, or after training step N; a later N goes on from there"))
            .arg(
                Arg::new("explain")
                    .long("explain")
                    .action(ArgAction::SetTrue)
                    .help("Only say which stages would be done again, and why"),
            )
            .arg(json()),
        )
        .subcommand(
            with_fields(
                with_table(
                    Command::new("segment").about("Click an object in one photo, get it in 3D"),
                    "segment",
                ),
                "vision",
                |name| matches!(name, "models" | "onnxruntime"),
            )
            .arg(run())
            .arg(
                Arg::new("photo")
                    .long("photo")
                    .value_name("NAME")
                    .action(ArgAction::Append)
                    .help("Photo that the prompts after it are on; may be given again for a second photo"),
            )
            .arg(positions("positive", "x,y", "Pixel that belongs to the object, at the photo's full size"))
            .arg(positions("negative", "x,y", "Pixel that does not"))
            .arg(positions("box", "x0,y0,x1,y1", "Box around the object"))
            .arg(
                Arg::new("granularity")
                    .long("granularity")
                    .value_name("G")
                    .value_parser(value_parser!(f32))
                    .help("0 = the finest part under the click, 1 = the largest thing [default: chosen]"),
            )
            .arg(
                path("prompts", "Make again what this file (a selection's prompts.json) was made from")
                    .conflicts_with_all(["photo", "positive", "negative", "box", "granularity"]),
            )
            .arg(
                Arg::new("name")
                    .long("name")
                    .value_name("NAME")
                    .default_value("object")
                    .help("Name of the selection"),
            )
            .arg(json()),
        )
        .subcommand(
            Command::new("render")
                .about("Draw views: a photo's, or a path between photos; any look; a selection")
                .arg(run())
                .arg(Arg::new("photo").long("photo").value_name("NAME").action(ArgAction::Append).help(
                    "View to draw; give two or more with --frames for a path through them [default: all]",
                ))
                .arg(
                    Arg::new("frames")
                        .long("frames")
                        .value_name("N")
                        .value_parser(value_parser!(u32).range(2..))
                        .help("Pictures along the path through the photos"),
                )
                .args(appearances("view's own; on a path from photo to photo"))
                .arg(Arg::new("selection").long("selection").value_name("NAME").help("Draw this selection"))
                .arg(
                    Arg::new("mode")
                        .long("mode")
                        .value_parser(["highlight", "only", "without", "scene"])
                        .requires("selection")
                        .help("How the selection is drawn [default: highlight; scene, as it is, with --object-appearance]"),
                )
                .arg(
                    Arg::new("what")
                        .long("what")
                        .value_parser(["colour", "depth", "alpha", "features"])
                        .default_value("colour")
                        .help("What is drawn"),
                )
                .arg(
                    Arg::new("width")
                        .long("width")
                        .value_name("PX")
                        .value_parser(value_parser!(u32).range(16..=16384))
                        .help("Long side of the pictures [default: as trained]"),
                )
                .arg(path("out", "Folder for the pictures [default: RUN/renders]"))
                .arg(json()),
        )
        .subcommand(
            Command::new("bake")
                .about("Write splats under a look as a .ply that any viewer shows: the scene or a selection")
                .arg(run())
                .args(appearances("scene's own"))
                .arg(Arg::new("selection").long("selection").value_name("NAME").help("The selection that is meant"))
                .arg(
                    Arg::new("mode")
                        .long("mode")
                        .value_parser(["only", "without", "scene"])
                        .help("What is written [default: only the selection; the scene with --object-appearance or no selection]"),
                )
                .arg(path("out", "The file [default: RUN/baked.ply]"))
                .arg(json()),
        )
        .subcommand(
            Command::new("eval")
                .about("Score held-out photos, and selections against true masks")
                .arg(run())
                .arg(path("truth", "Folder of true masks, a picture per photo, named as the photo"))
                .arg(path("transient-truth", "Score the run's pictures of transients against true ones, a picture per photo, named as the photo"))
                .arg(
                    Arg::new("selection").long("selection").value_name("NAME").help("The selection to score"),
                )
                .arg(json()),
        )
        .subcommand(crate::commands::batch::command())
        .subcommand(crate::commands::status::command())
        .subcommand(crate::commands::top::command())
        .subcommand(
            Command::new("cache")
                .about("Look after a run's cache of per-photo results")
                .subcommand_required(true)
                .subcommand(
                    Command::new("ls").about("List what is there, and what the run uses of it").arg(run()).arg(json()),
                )
                .subcommand(
                    Command::new("verify")
                        .about("Read every file and compare its hash; damaged ones are moved aside and made anew")
                        .arg(run())
                        .arg(json()),
                )
                .subcommand(
                    Command::new("gc")
                        .about("Remove what was made under other settings than the run's present ones")
                        .arg(run())
                        .arg(
                            number("limit", "0", "Oldest first, and only until the cache holds this many MiB")
                                .value_parser(value_parser!(u64)),
                        )
                        .arg(
                            Arg::new("dry-run")
                                .long("dry-run")
                                .action(ArgAction::SetTrue)
                                .help("Remove nothing, say what would go"),
                        )
                        .arg(json()),
                ),
        )
        .subcommand(
            Command::new("demo")
                .about("Make a synthetic scene, run the whole job on it, leave a report and pictures")
                .arg(path("out", "Folder [default: runs/demo]"))
                .arg(
                    Arg::new("seed")
                        .long("seed")
                        .value_name("N")
                        .value_parser(value_parser!(u64))
                        .default_value("1")
                        .help("Another number, another place"),
                )
                .arg(json()),
        )
        .subcommand(
            Command::new("doctor")
                .about("Say what this machine offers and what is used instead of what is missing")
                .arg(
                    Arg::new("settings")
                        .long("settings")
                        .action(ArgAction::SetTrue)
                        .help("Print the reference page of all settings"),
                )
                .arg(path("models", "Folder of network files to look at"))
                .arg(
                    Arg::new("kernels")
                        .long("kernels")
                        .value_name("ADAPTER")
                        .num_args(0..=1)
                        .default_missing_value("")
                        .help(
                            "Compare every kernel on an accelerator (part of its name; the best one if left out) with \
                             the CPU engine, and say which is the first to diverge",
                        ),
                )
                .arg(json()),
        )
        .subcommand(crate::commands::bench::command())
}

/// The run folder.
pub fn run() -> Arg {
    Arg::new("run").required(true).value_parser(value_parser!(PathBuf)).help("Run folder")
}

/// A flag that takes a number.
pub fn number(name: &'static str, default: &'static str, help: &'static str) -> Arg {
    Arg::new(name).long(name).value_name("N").default_value(default).help(help)
}

/// `--until`.
pub fn until(help: &'static str) -> Arg {
    Arg::new("until")
        .long("until")
        .value_name("STAGE|N")
        .value_parser(str::parse::<segwild_pipeline::Until>)
        .help(help)
}

/// `--json`.
pub fn json() -> Arg {
    Arg::new("json").long("json").action(ArgAction::SetTrue).help("One JSON object per line instead of text")
}

/// A flag that takes a path.
pub fn path(name: &'static str, help: &'static str) -> Arg {
    Arg::new(name).long(name).value_name("PATH").value_parser(value_parser!(PathBuf)).help(help)
}

fn positions(id: &'static str, form: &'static str, help: &'static str) -> Arg {
    Arg::new(id).long(id).value_name(form).action(ArgAction::Append).allow_hyphen_values(true).help(help)
}

/// Which look, for the scene and for the selection.
fn appearances(default: &str) -> [Arg; 5] {
    let appearance = |id: &'static str, help: String| {
        Arg::new(id).long(id).value_name("PHOTO").action(ArgAction::Append).help(help)
    };
    let strength = |id: &'static str, help| {
        Arg::new(id).long(id).value_name("X").value_parser(value_parser!(f32)).default_value("1").help(help)
    };
    [
        appearance(
            "appearance",
            format!(
                "Under this photo's look; `none` for the scene's own; again for a way between looks [default: the {default}]"
            ),
        ),
        appearance("object-appearance", "Another look for the selected object, in the same way".into()),
        strength("strength", "Strength of the look: 0 is the scene's own look, 1 the photo's, up to 2"),
        strength("object-strength", "The same for the object's look"),
        Arg::new("interpolate")
            .long("interpolate")
            .value_name("T")
            .value_parser(value_parser!(f32))
            .help("One look between those given: 0 is the first, 1 the last"),
    ]
}

/// Adds a flag for every setting of every table.
pub fn with_settings(mut command: Command) -> Command {
    for (table, _, _) in Settings::catalogue() {
        command = with_table(command, table);
    }
    command
}

/// Adds a flag for every setting of one table, under its own heading in the help.
fn with_table(command: Command, table: &str) -> Command {
    with_fields(command, table, |_| true)
}

/// The same for some of its settings.
fn with_fields(mut command: Command, table: &str, wanted: fn(&str) -> bool) -> Command {
    for (name, doc, fields) in Settings::catalogue() {
        if name != table {
            continue;
        }
        for field in fields.iter().filter(|field| wanted(field.name)) {
            let flag: &'static str = field.name.replace('_', "-").leak();
            let default = Settings::default().get(field.name).unwrap_or_default();
            let mut arg = Arg::new(field.name)
                .long(flag)
                .value_name(field.kind)
                .allow_hyphen_values(true)
                .help_heading(doc.trim_end_matches('.'))
                .help(format!(
                    "{} [default: {}]",
                    field.doc,
                    if default.is_empty() { "none" } else { &default }
                ));
            if !field.choices.is_empty() {
                arg = arg.value_parser(PossibleValuesParser::new(field.choices));
            }
            command = command.arg(arg);
        }
    }
    command
}

/// The settings given as flags, as `(name, value)` pairs.
pub fn given(matches: &ArgMatches) -> Vec<(String, String)> {
    let mut pairs = Vec::new();
    for (_, _, fields) in Settings::catalogue() {
        for field in fields {
            if let Ok(Some(value)) = matches.try_get_one::<String>(field.name) {
                pairs.push((field.name.to_owned(), value.clone()));
            }
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_command_line_is_consistent() {
        super::program().debug_assert();
    }
}
