//! `segwild bench engine`

use super::command_line::command_line;
use super::scene_args::each_of;
use crate::args::{examples, flag, json, list, numbers, path, path_of, pixels};
use crate::failure::Failure;
use crate::output::{print_json, print_line};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_bench::engine::{EngineOptions, Goal, engine as measure_all, write};
use segwild_eval::record::Record;
use segwild_gpu::AdapterChoice;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    Command::new("engine")
        .about("How fast the accelerator engine is: each pass against its floor and the CPU engine")
        .after_help(examples(
            "segwild bench engine --adapter NVIDIA",
            "segwild bench engine --no-cpu --splat-counts 10000,1000000",
        ))
        .arg(
            Arg::new("adapter")
                .long("adapter")
                .value_name("TEXT")
                .help("Part of the accelerator's name [default: the best hardware GPU]"),
        )
        .arg(each_of("splat-counts", "10000,100000,1000000,5000000", "Numbers of splats"))
        .arg(each_of("frame-sizes", "640x480,1920x1080,3840x2160", "Frames, in pixels"))
        .arg(each_of(
            "channel-counts",
            "3,16,64",
            "Numbers of channels, on the first frame with the first number of splats",
        ))
        .arg(flag("no-cpu", "Leave out the CPU engine beside it"))
        .arg(flag("no-subgroups", "Sum and sort without subgroups, even where the accelerator has some"))
        .arg(
            Arg::new("db")
                .long("db")
                .value_name("X")
                .default_value("24")
                .value_parser(value_parser!(f32))
                .help("Time a training of a synthetic scene up to so many dB; 0 leaves it out"),
        )
        .arg(pixels("320"))
        .arg(path("out", "Folder for that scene while it is trained [default: .bench/engine]"))
        .arg(path("page", "Write the page to this file"))
        .arg(json())
}

/// Measures, and prints as it goes.
pub fn engine(matches: &ArgMatches) -> Result<(), Failure> {
    let size = |text: String| {
        let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
        sides.ok_or_else(|| Failure::usage(format!("--frame-sizes: `{text}` is no frame such as 640x480")))
    };
    let db: f32 = *matches.get_one("db").expect("it has a default");
    let dir = path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/engine"));
    let options = EngineOptions {
        command: command_line(),
        choice: matches
            .get_one::<String>("adapter")
            .cloned()
            .map_or(AdapterChoice::Hardware, AdapterChoice::Named),
        splats: numbers(matches, "splat-counts")?,
        sizes: list(matches, "frame-sizes").into_iter().map(size).collect::<Result<_, _>>()?,
        channels: numbers(matches, "channel-counts")?,
        cpu: !matches.get_flag("no-cpu"),
        subgroups: !matches.get_flag("no-subgroups"),
        goal: (db > 0.0).then(|| Goal {
            db,
            size: *matches.get_one("pixels").expect("it has a default"),
            dir,
        }),
    };
    let json = matches.get_flag("json");
    let mut last = String::new();
    let report = |record: &Record| {
        if json {
            let _ = print_json(record);
            return;
        }
        if record.target != last {
            last.clone_from(&record.target);
            let _ = print_line(&last);
        }
        let numbers: Vec<String> = record.numbers.iter().map(|(n, v)| format!("{n} {v:.3}")).collect();
        let message = [numbers.join(", "), record.notes.join("; ")].concat();
        let _ = print_line(&format!("  {:<24} {message}", record.setting));
    };
    let results = measure_all(&options, report)?;
    if let Some(page) = path_of(matches, "page") {
        write(&page, &results)?;
    }
    Ok(())
}
