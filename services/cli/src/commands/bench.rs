//! `segwild bench`

use super::{path, print_json, print_line, use_threads};
use crate::failure::Failure;
use clap::ArgMatches;
use segwild_bench::ablation::{AblationOptions, Cell, ablation, markdown};
use segwild_bench::flow::{FlowOptions, Row, flow, measured, page};
use segwild_bench::oracle::OracleOptions;
use segwild_bench::synthetic::SyntheticOptions;
use segwild_bench::trial::ProviderKind;
use segwild_pipeline::Settings;
use std::path::PathBuf;

/// Prints the ablation table, or what `segwild bench flow` measures.
pub fn bench(matches: &ArgMatches) -> Result<(), Failure> {
    if let Some(("flow", matches)) = matches.subcommand() {
        return bench_flow(matches);
    }
    let out = path(matches, "out").unwrap_or_else(|| PathBuf::from(".bench"));
    let list = |name: &str| -> Vec<String> {
        let text = matches.get_one::<String>(name).map_or("", String::as_str);
        text.split(',').filter(|t| !t.is_empty()).map(str::to_owned).collect()
    };
    let seeds = list("seeds")
        .iter()
        .map(|s| {
            s.parse().map_err(|_| Failure::usage(format!("--seeds {s}: expected whole numbers with commas")))
        })
        .collect::<Result<Vec<u64>, _>>()?;
    let providers = match matches.get_one::<String>("providers").map(String::as_str) {
        Some("builtin") => ProviderKind::Builtin,
        _ => ProviderKind::Oracle,
    };
    let json = matches.get_flag("json");
    // A table needs many trainings: the quickest preset unless another is asked for.
    let mut given = vec![("preset".to_owned(), "draft".to_owned())];
    given.extend(crate::args::given(matches));
    let settings = Settings::layered(None, &given)?;
    use_threads(settings.run.threads);
    let number = |name: &str| *matches.get_one::<u32>(name).expect("it has a default");
    let photos = number("photos") as usize;
    let options = AblationOptions {
        seeds,
        only: list("only"),
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

/// Prints the ratios that the dataflow promises.
fn bench_flow(matches: &ArgMatches) -> Result<(), Failure> {
    let json = matches.get_flag("json");
    let list = |name: &str| -> Vec<String> {
        let text = matches.get_one::<String>(name).map_or("", String::as_str);
        text.split(',').filter(|t| !t.is_empty()).map(str::to_owned).collect()
    };
    let photos: Vec<usize> = list("photos").iter().filter_map(|p| p.parse().ok()).collect();
    let [few, many] = photos[..] else {
        return Err(Failure::usage("--photos: expected two numbers with a comma, as in 100,1000"));
    };
    let options = FlowOptions {
        dir: path(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/flow")),
        program: std::env::current_exe()?,
        only: list("only"),
        kills: *matches.get_one::<u32>("kills").expect("it has a default") as usize,
        photos: [few, many],
    };
    let told = |row: &Row| {
        let _ = if json {
            print_json(row)
        } else {
            let verdict = if row.holds() { "holds" } else { "OVER " };
            print_line(&format!(
                "{verdict} {:>15} {:>7.3} (<= {}) {}: {}",
                row.name, row.value, row.bar, row.what, row.from
            ))
        };
    };
    let rows = flow(&options, told)?;
    if let Some(file) = path(matches, "page") {
        std::fs::write(&file, page(&measured(&options.dir))).map_err(|e| Failure {
            message: format!("cannot write {}: {e}", file.display()),
            code: crate::exit::FAILED,
        })?;
    }
    match rows.iter().filter(|r| !r.holds()).count() {
        0 => Ok(()),
        n => Err(Failure {
            message: format!("{n} of {} promises are not kept", rows.len()),
            code: crate::exit::FAILED,
        }),
    }
}
