//! `segwild bench folder`

use super::protocol_flags::{clicks, finish, flags, measure_scenes, table, with_common, with_table};
use super::scene_args::{parts, parts_of};
use crate::args::{examples, list, number, path_of};
use crate::failure::Failure;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::protocols::folder::{FolderProtocol, scenes};
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("folder")
        .about("Find the objects of a scene that has true masks in SCENE/truth")
        .after_help(examples(
            "segwild bench folder photos/trevi",
            "segwild bench folder photos/trevi --table ablation",
        ));
    let command = with_common(command, "1", "Folder for runs and results [default: .bench/folder]");
    with_table(command, "baselines")
        .arg(
            Arg::new("scene")
                .required(true)
                .value_name("SCENE")
                .value_parser(value_parser!(PathBuf))
                .help("The scene: photos, reconstruction, and truth/PHOTO.png or truth/OBJECT/PHOTO.png"),
        )
        .arg(Arg::new("references").long("references").value_name("PHOTOS").help(
            "Photos to click, with commas, by their names or how those begin [default: drawn by the seed]",
        ))
        .arg(
            number("draw", "4", "So many photos are drawn for each object")
                .value_parser(value_parser!(u32).range(1..)),
        )
        .arg(clicks("1"))
        .arg(parts())
}

/// Prints the tables.
pub fn folder(matches: &ArgMatches) -> Result<(), Failure> {
    let mut flags = flags(matches, ".bench/folder")?;
    let number = |name: &str| *matches.get_one::<u32>(name).expect("it has a default") as usize;
    let options = FolderProtocol {
        scene: path_of(matches, "scene").expect("clap requires it"),
        references: list(matches, "references"),
        draw: number("draw"),
        clicks: number("clicks"),
        parts: parts_of(matches)?,
    };
    measure_scenes(&mut flags, table(matches), |settings, seed| scenes(&options, settings, seed))?;
    let title = flags.results.records.first().map_or_else(String::new, |r| r.scene.clone());
    finish(&flags, &title)
}
