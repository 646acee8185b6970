//! `segwild bench photo-tourism`

use super::protocol_flags::{finish, flags, measure_scenes, table, with_common, with_table};
use crate::args::{examples, list, number, path_of};
use crate::failure::Failure;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::protocols::photo_tourism::{LAYOUT, PhotoTourismProtocol, scenes};
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("photo-tourism")
        .about("The paper's nine targets in three scenes of Photo Tourism, and PSNR on held-out photos")
        .after_help(format!(
            "{LAYOUT}\n\n{}",
            examples(
                "segwild bench photo-tourism data/photo-tourism",
                "segwild bench photo-tourism data/photo-tourism --table ablation"
            )
        ));
    with_table(
        with_common(command, "1", "Folder for runs and results [default: .bench/photo-tourism]"),
        "baselines",
    )
    .arg(Arg::new("root").required(true).value_parser(value_parser!(PathBuf)).help("Folder of the scenes"))
    .arg(
        Arg::new("scenes")
            .long("scenes")
            .value_name("LIST")
            .help("Scenes, with commas: brandenburg_gate, trevi_fountain, taj_mahal [default: all]"),
    )
    .arg(
        number(
            "clicks",
            "1",
            "Clicks on each reference photo: where its mask is deepest, and then away from there",
        )
        .value_parser(value_parser!(u32).range(1..)),
    )
}

/// Prints the tables.
pub fn photo_tourism(matches: &ArgMatches) -> Result<(), Failure> {
    let mut flags = flags(matches, ".bench/photo-tourism")?;
    let options = PhotoTourismProtocol {
        root: path_of(matches, "root").expect("clap requires it"),
        only: list(matches, "scenes"),
        clicks: *matches.get_one::<u32>("clicks").expect("it has a default") as usize,
    };
    measure_scenes(&mut flags, table(matches), |settings, seed| scenes(&options, settings, seed))?;
    finish(&flags, "Photo Tourism")
}
