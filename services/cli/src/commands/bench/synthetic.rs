//! `segwild bench synthetic`

use super::{list, numbers};
use crate::args::{given, json, number, path, with_settings};
use crate::commands::{path as path_of, print_json, print_line, use_threads};
use crate::failure::Failure;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_bench::ablation::{AblationOptions, Cell, ablation, markdown};
use segwild_bench::oracle::OracleOptions;
use segwild_bench::synthetic::SyntheticOptions;
use segwild_bench::trial::ProviderKind;
use segwild_pipeline::Settings;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    with_args(
        Command::new("synthetic")
            .about("The ablation table on synthetic places, whose truth is known exactly"),
    )
}

/// Adds them to a command.
pub fn with_args(command: Command) -> Command {
    with_settings(command)
        .arg(
            Arg::new("providers")
                .long("providers")
                .value_parser(["oracle", "builtin"])
                .default_value("oracle")
                .help("Who looks at the photos: the truth with faults, or what the settings name"),
        )
        .arg(number("photos", "60", "Training photos of each scene").value_parser(value_parser!(u32)))
        .arg(number("pixels", "480", "Long side of the photos").value_parser(value_parser!(u32)))
        .arg(
            number("occlusion", "0.1", "Share of each photo that strangers cover, 0 to 0.6")
                .value_parser(value_parser!(f32)),
        )
        .arg(
            number("kinship", "0", "How much all built things are alike to the oracle's embedding, 0 to 1")
                .value_parser(value_parser!(f32)),
        )
        .arg(
            number("units", "1", "File units per unit of the place: nothing may depend on it")
                .value_parser(value_parser!(f64)),
        )
        .arg(
            Arg::new("seeds")
                .long("seeds")
                .value_name("LIST")
                .default_value("1,2")
                .help("Seeds of the synthetic scenes, with commas"),
        )
        .arg(
            Arg::new("only")
                .long("only")
                .value_name("ROWS")
                .help("Rows of the table to compute, with commas [default: all]"),
        )
        .arg(path("out", "Folder for scenes, runs and tables [default: .bench]"))
        .arg(json())
}

/// Prints the ablation table.
pub fn synthetic(matches: &ArgMatches) -> Result<(), Failure> {
    let out = path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench"));
    let providers = match matches.get_one::<String>("providers").map(String::as_str) {
        Some("builtin") => ProviderKind::Builtin,
        _ => ProviderKind::Oracle,
    };
    let json = matches.get_flag("json");
    // A table needs many trainings: the quickest preset unless another is asked for.
    let mut flags = vec![("preset".to_owned(), "draft".to_owned())];
    flags.extend(given(matches));
    let settings = Settings::layered(None, &flags)?;
    use_threads(settings.run.threads);
    let number = |name: &str| *matches.get_one::<u32>(name).expect("it has a default");
    let photos = number("photos") as usize;
    let options = AblationOptions {
        seeds: numbers(matches, "seeds")?,
        only: list(matches, "only"),
        providers,
        faults: OracleOptions {
            kinship: *matches.get_one::<f32>("kinship").expect("it has a default"),
            ..OracleOptions::default()
        },
        scene: SyntheticOptions {
            train: photos,
            test: photos.div_ceil(5),
            long_side: number("pixels"),
            occlusion: *matches.get_one::<f32>("occlusion").expect("it has a default"),
            units: *matches.get_one::<f64>("units").expect("it has a default"),
            ..SyntheticOptions::default()
        },
        settings,
    };
    let told = |cell: &Cell| {
        let _ = if json {
            print_json(cell)
        } else {
            let s = &cell.score;
            print_line(&format!(
                "seed {} {:>20} {:>16} IoU {:.3} (worst of {} photos {:.3}) amodal {:.3} boundary {:.3} 3D {:.3} hidden {:.4}",
                cell.seed,
                cell.variant,
                s.object,
                s.iou,
                s.photos,
                s.worst,
                s.amodal_iou,
                s.boundary_iou,
                s.label_iou,
                s.hidden
            ))
        };
    };
    let cells = ablation(&out, &options, told)?;
    if json { Ok(()) } else { print_line(&format!("\n{}", markdown(&cells))) }
}
