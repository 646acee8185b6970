//! `segwild bench reconstruction`

use super::command_line::command_line;
use super::scene_args::{each_of, scenes_and_sizes};
use crate::args::{examples, given, json, numbers, path, path_of, with_settings_in_long_help};
use crate::failure::Failure;
use crate::operators::use_threads;
use crate::output::{print_json, print_line, print_warning};
use clap::{ArgMatches, Command};
use segwild_bench::reconstruction::{ReconstructionOptions, reconstruction as measure_all, write};
use segwild_eval::record::{LPIPS_COLUMNS, Record};
use segwild_pipeline::Settings;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("reconstruction")
        .about("How well scenes are reconstructed: each photo held out is scored whole, and shown beside its render")
        .after_help(examples(
            "segwild bench reconstruction photos/trevi photos/garden",
            "segwild bench reconstruction photos/trevi --sizes 320,640 --seeds 1,2",
        ))
        .args(scenes_and_sizes("Scenes as for `segwild run`. Where neither they nor the settings hold photos out, every eighth is"))
        .arg(each_of("seeds", "1", "Seeds of the trainings, with commas"))
        .arg(path("out", "Folder for results, page and images [default: .bench/reconstruction]"))
        .arg(path("page", "Write the page to this file as well, without images of the photos"))
        .arg(json());
    with_settings_in_long_help(command)
}

/// Measures, and writes the page.
pub fn reconstruction(matches: &ArgMatches) -> Result<(), Failure> {
    let settings = given(matches);
    use_threads(Settings::layered(None, &settings)?.run.threads);
    let options = ReconstructionOptions {
        scenes: matches.get_many("scenes").expect("clap requires it").cloned().collect(),
        sizes: numbers(matches, "sizes")?,
        seeds: numbers(matches, "seeds")?,
        out: path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/reconstruction")),
        command: command_line(),
        settings,
    };
    let json = matches.get_flag("json");
    let report = |records: &[Record]| {
        let _ = if json { records.iter().try_for_each(print_json) } else { tell(records) };
    };
    let results = measure_all(&options, report)?;
    for what in &results.missing {
        print_warning(&format!("not measured: {what}"));
    }
    let page = write(&options.out, path_of(matches, "page").as_deref(), &results)?;
    if json {
        return Ok(());
    }
    print_line(&format!("page: {}", page.display()))
}

fn tell(records: &[Record]) -> Result<(), Failure> {
    for r in records {
        let size = r.at.unwrap_or_default();
        let of = |name: &str| r.numbers.get(name).copied().unwrap_or(f64::NAN);
        let lpips: String = LPIPS_COLUMNS
            .iter()
            .filter_map(|(name, words)| r.numbers.get(*name).map(|value| format!(", {words} {value:.3}")))
            .collect();
        print_line(&if r.target.is_empty() {
            format!(
                "{} {size} px: held out {:.2} dB, SSIM {:.3}{lpips}; training photos {:.2} dB, {:.1} % taken for transients; {:.0} CPU-s",
                r.scene,
                of("psnr"),
                of("ssim"),
                of("train_psnr"),
                100.0 * of("transient"),
                of("cpu_s")
            )
        } else {
            format!("{} {size} px: held out {:.2} dB in the box around {}", r.scene, of("psnr"), r.target)
        })?;
    }
    Ok(())
}
