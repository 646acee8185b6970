//! `segwild bench synthetic`

use super::protocol_flags::{finish, flags, table, tell, with_common, with_table};
use super::scene_args::{light, light_of, occlusion, providers, providers_of, scene_of, with_scene};
use crate::args::{examples, number};
use crate::failure::Failure;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::oracle::OracleOptions;
use segwild_eval::protocols::synthetic::{SyntheticProtocol, Targets, synthetic as measure};
use segwild_synthetic::SyntheticOptions;

/// The benchmark's arguments.
pub fn command() -> Command {
    with_args(
        Command::new("synthetic")
            .about("Find the objects of synthetic scenes, whose truth is known exactly")
            .after_help(examples(
                "segwild bench synthetic --table baselines",
                "segwild bench synthetic --seeds 1,2 --providers oracle",
            )),
    )
}

/// Adds them to a command.
pub fn with_args(command: Command) -> Command {
    let command = with_common(command, "1,2", "Folder for scenes, runs and results [default: .bench]");
    with_scene(with_table(command, "ablation"), "60", "480")
        .arg(providers())
        .arg(
            Arg::new("targets")
                .long("targets")
                .value_name("WORD")
                .value_parser(["objects", "surfaces"])
                .default_value("objects")
                .help("What is clicked: objects, or the ground and walls that they stand on and before"),
        )
        .arg(
            number(
                "clicks-per-object",
                "1",
                "Clicks on each object, each measured by itself; more than 1 lie anywhere on it",
            )
            .value_parser(value_parser!(u32).range(1..)),
        )
        .arg(occlusion())
        .arg(light())
        .arg(
            number(
                "embedding-similarity",
                "0",
                "How alike the oracle's embedding makes different things: their mean cosine, 0 to 1",
            )
            .value_parser(value_parser!(f32)),
        )
        .arg(
            number("units", "1", "Scale of the written scene; results must not change")
                .value_parser(value_parser!(f64)),
        )
}

/// Prints the tables.
pub fn synthetic(matches: &ArgMatches) -> Result<(), Failure> {
    let mut flags = flags(matches, ".bench")?;
    let number = |name: &str| *matches.get_one::<f32>(name).expect("it has a default");
    let word = |name: &str| matches.get_one::<String>(name).map_or("", String::as_str);
    let options = SyntheticProtocol {
        table: table(matches),
        only: flags.only.clone(),
        seeds: flags.seeds.clone(),
        prompts: *matches.get_one::<u32>("clicks-per-object").expect("it has a default") as usize,
        providers: providers_of(matches),
        targets: if word("targets") == "surfaces" { Targets::Surfaces } else { Targets::Objects },
        faults: OracleOptions {
            embedding_similarity: number("embedding-similarity"),
            ..OracleOptions::default()
        },
        scene: SyntheticOptions {
            occlusion: number("occlusion"),
            photo_light: light_of(matches)?,
            units: *matches.get_one::<f64>("units").expect("it has a default"),
            ..scene_of(matches)
        },
        base: flags.base.clone(),
    };
    measure(&flags.out, &options, &mut flags.results, &mut tell(flags.json))?;
    finish(&flags, "Synthetic scenes")
}
