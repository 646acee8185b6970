//! `segwild bench lego`

use super::common::{asked, default_setting, finish, providers, providers_of, tell, with_common};
use super::synthetic::{scene, with_scene};
use crate::failure::Failure;
use clap::{ArgMatches, Command};
use segwild_bench::protocols::lego::{LegoProtocol, lego as measure};

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("lego")
        .about("NeRF-W's perturbations: what other colours and a striped square before each photo cost");
    with_scene(
        with_common(command, "1", "Folder for scenes, runs and results [default: .bench/lego]"),
        "60",
        "320",
    )
    .arg(providers())
}

/// Prints the table.
pub fn lego(matches: &ArgMatches) -> Result<(), Failure> {
    let mut asked = asked(matches, ".bench/lego")?;
    // The perturbed photos have a look each; the clean ones pay for it as the perturbed ones do.
    default_setting(matches, &mut asked, "appearance_model", "affine")?;
    let options = LegoProtocol {
        only: asked.only.clone(),
        seeds: asked.seeds.clone(),
        scene: scene(matches),
        providers: providers_of(matches),
        base: asked.base.clone(),
    };
    measure(&asked.out, &options, &mut asked.results, &mut tell(asked.json))?;
    finish(&asked, "Perturbed photos")
}
