//! `segwild bench chart`, and `segwild bench point`, which measures one of its points in a process of its own.

use super::command_line::command_line;
use super::scene_args::{
    each_of, light, light_of, occlusion, only, parts, parts_of, providers, providers_of,
};
use crate::args::{
    examples, given, json, list, numbers, path, path_of, photo_count, pixels, with_settings_in_long_help,
};
use crate::failure::Failure;
use crate::operators::use_threads;
use crate::output::{print_json, print_line, print_warning};
use clap::{ArgMatches, Command};
use segwild_bench::chart::{ChartBase, ChartEvent, ChartOptions, chart as measure_all, write};
use segwild_bench::point::{PhotoSource, PointJob, measure};
use segwild_eval::oracle::OracleOptions;
use segwild_eval::record::{Record, means};
use segwild_eval::trial::ProviderKind;
use segwild_synthetic::SyntheticOptions;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("chart")
        .about("Accuracy against time and memory: one setting varied at a time around a default")
        .after_help(examples("segwild bench chart --scene photos/trevi", "segwild bench chart --only steps,appearance_model --seeds 1,2"))
        .arg(path("scene", "A folder of photos with true masks in `truth/` [default: synthetic scenes]"))
        .arg(parts())
        .arg(each_of("scene-seeds", "1", "Seeds of the synthetic scenes, with commas; a point is their mean"))
        .arg(each_of("seeds", "1,2", "Seeds of the training, with commas: what the error bars are over"))
        .arg(photo_count("24"))
        .arg(pixels("240"))
        .arg(occlusion())
        .arg(light())
        .arg(providers())
        .arg(only(
            "Sweeps to measure, with commas: preset, steps, splats, channels, size, appearance_model, refine, prompts, density, budget, or single points of them as in appearance_model=embed [default: all]",
        ))
        .arg(path("out", "Folder for results; what is there is not measured again [default: .bench/chart]"))
        .arg(path("page-folder", "Folder for the page, figures and data [default: the folder of the results]"))
        .arg(json());
    with_settings_in_long_help(command)
}

/// The hidden command that measures one point.
pub fn point_command() -> Command {
    Command::new("point").about("Measure one point, given as JSON on standard input").hide(true)
}

/// Measures what is not known yet, and writes the page.
pub fn chart(matches: &ArgMatches) -> Result<(), Failure> {
    let out = path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/chart"));
    let json = matches.get_flag("json");
    let photos = *matches.get_one::<u32>("photo-count").expect("it has a default") as usize;
    let (sources, about) = match path_of(matches, "scene") {
        Some(scene) => {
            let scene = std::path::absolute(&scene)?;
            let source = PhotoSource::Folder { path: scene, parts: parts_of(matches)? };
            let name = source.name();
            (vec![source], name)
        }
        None => {
            let seeds: Vec<u64> = numbers(matches, "scene-seeds")?;
            let options = SyntheticOptions {
                train: photos,
                test: photos.div_ceil(5),
                long_side: *matches.get_one::<u32>("pixels").expect("it has a default"),
                occlusion: *matches.get_one::<f32>("occlusion").expect("it has a default"),
                photo_light: light_of(matches)?,
                ..SyntheticOptions::default()
            };
            let scenes = if seeds.len() == 1 { "scene" } else { "scenes" };
            let about =
                format!("{} synthetic {scenes} of {photos} photos, {} px", seeds.len(), options.long_side);
            (
                seeds
                    .iter()
                    .map(|&seed| PhotoSource::Synthetic(SyntheticOptions { seed, ..options.clone() }))
                    .collect(),
                about,
            )
        }
    };
    let providers = providers_of(matches);
    if providers == ProviderKind::Oracle && matches!(sources[..], [PhotoSource::Folder { .. }]) {
        return Err(Failure::usage("--providers oracle: the oracle knows synthetic scenes only, no --scene"));
    }
    let options = ChartOptions {
        program: std::env::current_exe()?,
        command: command_line(),
        only: list(matches, "only"),
        seeds: numbers(matches, "seeds")?,
        base: ChartBase { sources, providers, faults: OracleOptions::default(), settings: given(matches) },
        out: out.clone(),
    };
    let results = measure_all(&options, |event| tell(&event, json))?;
    let page = path_of(matches, "page-folder").unwrap_or(out);
    let verdicts = write(&page, &results, &about)?;
    if json {
        return Ok(());
    }
    for verdict in verdicts {
        print_line(&verdict.words())?;
    }
    print_line(&format!("page: {}", page.join("index.html").display()))
}

fn tell(event: &ChartEvent, json: bool) {
    let _ = match event {
        ChartEvent::Point { records, .. } if json => records.iter().try_for_each(print_json),
        ChartEvent::Point { records, known } => {
            let Some(first) = records.iter().find(|r| r.target.is_empty()) else { return };
            let all = means(&records.iter().collect::<Vec<&Record>>());
            let of = |name: &str| all.get(name).copied().unwrap_or(f64::NAN);
            let at = first.at.map_or(String::new(), |at| format!(" {at}"));
            print_line(&format!(
                "{:>18} {} seed {}, masks of {}: IoU {:.3}, {:.2} dB, {:.1} CPU-s, {:.0} MiB, {:.0} splats{}",
                first.setting.clone() + &at,
                first.scene,
                first.seed,
                first.provider,
                of("iou"),
                of("psnr"),
                of("cpu_s"),
                of("peak_mib"),
                of("splats"),
                if *known { " (known)" } else { "" }
            ))
        }
        ChartEvent::Failed { point, error } => {
            print_warning(&format!("{point} could not be measured: {error}"));
            Ok(())
        }
    };
}

/// Measures the point that standard input describes.
pub fn point() -> Result<(), Failure> {
    let job: PointJob = serde_json::from_reader(std::io::stdin())
        .map_err(|e| Failure::usage(format!("the point cannot be read: {e}")))?;
    use_threads(job.settings()?.run.threads);
    print_json(&measure(&job)?)
}
