//! `segwild bench scale`

use super::command_line::command_line;
use super::scene_args::{each_of, only, photo_sizes};
use crate::args::{examples, json, list, numbers, path, path_of};
use crate::failure::Failure;
use crate::output::{print_json, print_line};
use clap::{ArgMatches, Command};
use segwild_bench::scale::{AXES, Fit, ScaleOptions, along, scale as measure_all, write};
use segwild_eval::record::Record;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    Command::new("scale")
        .about("How time and memory grow, with slopes: splats, photos, pixels, channels, objects, clicks")
        .after_help(examples("segwild bench scale", "segwild bench scale --photo-counts 10,100 --splat-counts 2000,16000"))
        .arg(only(
            "Axes to measure, with commas: kernels splats, kernels pixels, kernels channels, photos, splats, pixels, objects, clicks [default: all]",
        ))
        .arg(each_of("kernel-splats", "1000,10000,100000,500000,2000000", "Splats of the kernels' frame"))
        .arg(each_of("kernel-pixels", "160,320,640,1280", "Widths of the kernels' frame"))
        .arg(each_of("kernel-channels", "3,16,32,64,128", "Channels of the kernels' frame"))
        .arg(each_of("photo-counts", "10,30,100,300", "Photos of whole runs"))
        .arg(each_of("splat-counts", "2000,16000,64000", "Most splats of whole runs"))
        .arg(photo_sizes("80,160,320"))
        .arg(each_of("click-photo-counts", "10,30,100,300,1000,1500", "Photos of whole runs that are clicked"))
        .arg(path("out", "Folder for results; what is there is not measured again [default: .bench/scale]"))
        .arg(path("page", "Write the page to this file"))
        .arg(json())
}

/// Measures what is not known yet, and prints the slopes.
pub fn scale(matches: &ArgMatches) -> Result<(), Failure> {
    let options = ScaleOptions {
        out: path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/scale")),
        program: std::env::current_exe()?,
        command: command_line(),
        only: list(matches, "only"),
        kernel_splats: numbers(matches, "kernel-splats")?,
        kernel_pixels: numbers(matches, "kernel-pixels")?,
        kernel_channels: numbers(matches, "kernel-channels")?,
        photos: numbers(matches, "photo-counts")?,
        splats: numbers(matches, "splat-counts")?,
        pixels: numbers(matches, "sizes")?,
        clicks: numbers(matches, "click-photo-counts")?,
    };
    let json = matches.get_flag("json");
    let report = |record: &Record| {
        let numbers: Vec<String> = record.numbers.iter().map(|(n, v)| format!("{n} {v:.2}")).collect();
        let at = record.at.unwrap_or(0.0);
        let line = format!("{:>16} {at:>9}: {}", record.setting, numbers.join(", "));
        let _ = if json { print_json(record) } else { print_line(&line) };
    };
    let results = measure_all(&options, report)?;
    if let Some(page) = path_of(matches, "page") {
        write(&page, &results)?;
    }
    if json {
        return Ok(());
    }
    for axis in AXES {
        for number in [
            "project_ms",
            "forward_ms",
            "backward_ms",
            "gather_ms",
            "cpu_s",
            "all_clicks_s",
            "first_s",
            "click_s",
            "visited",
            "peak_mib",
        ] {
            if let Some(fit) = Fit::of(&along(&results, axis, number)) {
                print_line(&format!("{axis}: {number} slope {:.2}, last {:.2}", fit.slope, fit.last))?;
            }
        }
    }
    Ok(())
}
