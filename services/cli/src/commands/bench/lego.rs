//! `segwild bench lego`

use super::protocol_flags::{default_setting, finish, flags, tell, with_common};
use super::scene_args::{providers, providers_of};
use super::scene_args::{scene_of, with_scene};
use crate::args::examples;
use crate::failure::Failure;
use clap::{ArgMatches, Command};
use segwild_eval::protocols::lego::{LegoProtocol, lego as measure};

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("lego")
        .about("NeRF-W's perturbations: what other colours and a striped square before each photo cost")
        .after_help(examples("segwild bench lego", "segwild bench lego --seeds 1,2 --page lego.md"));
    with_scene(
        with_common(command, "1", "Folder for scenes, runs and results [default: .bench/lego]"),
        "60",
        "320",
    )
    .arg(providers())
}

/// Prints the table.
pub fn lego(matches: &ArgMatches) -> Result<(), Failure> {
    let mut flags = flags(matches, ".bench/lego")?;
    // The perturbed photos have an appearance each; the clean ones pay for it as the perturbed ones do.
    default_setting(matches, &mut flags, "appearance_model", "affine")?;
    let options = LegoProtocol {
        only: flags.only.clone(),
        seeds: flags.seeds.clone(),
        scene: scene_of(matches),
        providers: providers_of(matches),
        base: flags.base.clone(),
    };
    measure(&flags.out, &options, &mut flags.results, &mut tell(flags.json))?;
    finish(&flags, "Perturbed photos")
}
