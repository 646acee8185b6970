//! `segwild bench`

use super::{path, print_json, print_line, use_threads};
use crate::failure::Failure;
use clap::ArgMatches;
use segwild_bench::ablation::{AblationOptions, Cell, ablation, markdown};
use segwild_bench::oracle::OracleOptions;
use segwild_bench::synthetic::SyntheticOptions;
use segwild_bench::trial::ProviderKind;
use segwild_pipeline::Settings;
use std::path::PathBuf;

/// Prints the ablation table.
pub fn bench(matches: &ArgMatches) -> Result<(), Failure> {
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
        faults: OracleOptions::default(),
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
