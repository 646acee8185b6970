//! `segwild bench nvos` and `segwild bench spin-nerf`: other people's annotations of forward-facing scenes.

use super::protocol_flags::{
    clicks, data_and_examples, finish, flags, measure_scenes, root, table, with_common, with_table,
};
use crate::args::{list, number, path_of};
use crate::failure::Failure;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::protocols::{nvos, spin_nerf};

fn with_args(command: Command, folder: &'static str, clicks: Arg) -> Command {
    with_table(with_common(command, "1", folder), "baselines")
        .arg(root("Folder of the data"))
        .arg(Arg::new("scenes").long("scenes").value_name("LIST").help("Scenes, with commas [default: all]"))
        .arg(clicks)
}

/// The arguments of `nvos`.
pub fn nvos_command() -> Command {
    let command = Command::new("nvos").about("NVOS: scribbles on one photo, the mask of another").after_help(
        data_and_examples(
            "The annotations are published with NVOS, the photos with LLFF.",
            "segwild bench nvos data/nvos",
            "segwild bench nvos data/nvos --table ablation",
        ),
    );
    let help = "Most clicks taken from the scribbles inside, and as many from those outside";
    let clicks = number("scribble-clicks", "8", help).value_parser(value_parser!(u32).range(1..));
    with_args(command, "Folder for runs and results [default: .bench/nvos]", clicks)
}

/// The arguments of `spin-nerf`.
pub fn spin_nerf_command() -> Command {
    let command = Command::new("spin-nerf")
        .about("SPIn-NeRF: the mask of one photo is clicked, those of the others score it")
        .after_help(data_and_examples(
            "The masks are published with SPIn-NeRF (MVSeg), the photos with the data sets that it names.",
            "segwild bench spin-nerf data/spin-nerf",
            "segwild bench spin-nerf data/spin-nerf --table ablation",
        ));
    with_args(command, "Folder for runs and results [default: .bench/spin-nerf]", clicks("3"))
}

/// Prints the tables of NVOS.
pub fn nvos(matches: &ArgMatches) -> Result<(), Failure> {
    let mut flags = flags(matches, ".bench/nvos")?;
    let options = nvos::NvosProtocol {
        root: path_of(matches, "root").expect("clap requires it"),
        only: list(matches, "scenes"),
        clicks: *matches.get_one::<u32>("scribble-clicks").expect("it has a default") as usize,
    };
    measure_scenes(&mut flags, table(matches), |settings, seed| nvos::scenes(&options, settings, seed))?;
    finish(&flags, "NVOS")
}

/// Prints the tables of SPIn-NeRF.
pub fn spin_nerf(matches: &ArgMatches) -> Result<(), Failure> {
    let mut flags = flags(matches, ".bench/spin-nerf")?;
    let options = spin_nerf::SpinNerfProtocol {
        root: path_of(matches, "root").expect("clap requires it"),
        only: list(matches, "scenes"),
        clicks: *matches.get_one::<u32>("clicks").expect("it has a default") as usize,
    };
    measure_scenes(&mut flags, table(matches), |settings, seed| spin_nerf::scenes(&options, settings, seed))?;
    finish(&flags, "SPIn-NeRF")
}
