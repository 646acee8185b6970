//! `segwild bench stability`

use super::command_line::command_line;
use super::scene_args::{each_of, only, providers, providers_of};
use crate::args::{
    examples, given, json, list, numbers, path, path_of, photo_count, pixels, with_settings_in_long_help,
};
use crate::failure::Failure;
use crate::operators::use_threads;
use crate::output::{print_json, print_line};
use clap::{ArgMatches, Command};
use segwild_bench::stability::{StabilityOptions, curves, defaults, stability as measure_all, write};
use segwild_eval::record::{Record, means};
use segwild_pipeline::Settings;
use segwild_synthetic::SyntheticOptions;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("stability")
        .about("Where it fails, and whether it says so: quality against each kind of stress")
        .after_help(examples(
            "segwild bench stability",
            "segwild bench stability --photo-count 20 --page stability.md",
        ))
        .arg(only("Stresses to measure, with commas; also seeds, bytes and kernels [default: all]"))
        .arg(each_of("seeds", "1", "Seeds of the scenes and of the trainings, with commas"))
        .arg(providers())
        .arg(photo_count("20"))
        .arg(pixels("160"))
        .arg(path(
            "out",
            "Folder for results; what is there is not measured again [default: .bench/stability]",
        ))
        .arg(path("page", "Write the page to this file, and its figure beside it"))
        .arg(json());
    with_settings_in_long_help(command)
}

/// Measures what is not known yet, and says where the curves break.
pub fn stability(matches: &ArgMatches) -> Result<(), Failure> {
    let (scene, mut settings) = defaults();
    settings.extend(given(matches));
    use_threads(Settings::layered(None, &settings)?.run.threads);
    let of = |name: &str| *matches.get_one::<u32>(name).expect("it has a default");
    let photos = of("photo-count") as usize;
    let options = StabilityOptions {
        out: path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/stability")),
        command: command_line(),
        only: list(matches, "only"),
        seeds: numbers(matches, "seeds")?,
        providers: providers_of(matches),
        scene: SyntheticOptions { train: photos, long_side: of("pixels"), ..scene },
        settings,
    };
    let json = matches.get_flag("json");
    let report = |records: &[Record]| {
        let _ = if json { records.iter().try_for_each(print_json) } else { tell(records) };
    };
    let results = measure_all(&options, report)?;
    if let Some(page) = path_of(matches, "page") {
        write(&page, &results)?;
    }
    if json {
        return Ok(());
    }
    for curve in curves(&results) {
        let Some(at) = curve.breaks else { continue };
        let message =
            curve.announced.first().map_or("and no warning is given".into(), |s| format!("announced: {s}"));
        print_line(&format!("{} breaks at {at}, {message}", curve.name))?;
    }
    Ok(())
}

fn tell(records: &[Record]) -> Result<(), Failure> {
    let Some(first) = records.first() else { return Ok(()) };
    let all = means(&records.iter().collect::<Vec<_>>());
    let numbers: Vec<String> = ["iou", "psnr", "same", "off", "finite"]
        .iter()
        .filter_map(|name| Some(format!("{name} {:.3}", all.get(*name)?)))
        .collect();
    let at = first.at.map_or(String::new(), |at| format!(" {at}"));
    let message = first.notes.join("; ");
    print_line(&format!(
        "{:>24} seed {} {}: {} {message}",
        first.setting.clone() + &at,
        first.seed,
        first.provider,
        numbers.join(" ")
    ))
}
