//! `segwild bench photo-tourism`

use super::protocol_flags::{
    clicks, data_and_examples, finish, flags, measure_scenes, root, table, with_common, with_table,
};
use crate::args::{list, path_of};
use crate::failure::Failure;
use clap::{Arg, ArgMatches, Command};
use segwild_eval::protocols::photo_tourism::{PhotoTourismProtocol, scenes};

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("photo-tourism")
        .about("The paper's nine targets in three scenes of Photo Tourism, and PSNR on held-out photos")
        .after_help(data_and_examples(
            "The photos are the Image Matching Challenge's, the splits NeRF-W's, the masks your own.",
            "segwild bench photo-tourism data/photo-tourism",
            "segwild bench photo-tourism data/photo-tourism --table ablation",
        ));
    with_table(
        with_common(command, "1", "Folder for runs and results [default: .bench/photo-tourism]"),
        "baselines",
    )
    .arg(root("Folder of the scenes"))
    .arg(
        Arg::new("scenes")
            .long("scenes")
            .value_name("LIST")
            .help("Scenes, with commas: brandenburg_gate, trevi_fountain, taj_mahal [default: all]"),
    )
    .arg(clicks("1"))
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
