//! `segwild bench clicks`

use super::command_line::command_line;
use super::scene_args::scenes_and_sizes;
use crate::args::{examples, flag, given, json, number, numbers, path, path_of, with_settings_in_long_help};
use crate::failure::Failure;
use crate::operators::use_threads;
use crate::output::{print_json, print_line, print_warning};
use clap::{ArgMatches, Command, value_parser};
use segwild_bench::random_clicks::{ClickOptions, random_clicks, write};
use segwild_eval::record::Record;
use segwild_pipeline::Settings;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("clicks")
        .about("What single clicks or boxes find, anywhere on the objects of scenes with true masks")
        .after_help(examples(
            "segwild bench clicks photos/trevi photos/garden",
            "segwild bench clicks photos/trevi --clicks-per-object 8 --alternatives --corrections 9",
        ))
        .args(scenes_and_sizes(
            "Scenes with truth/PHOTO.png or truth/OBJECT/PHOTO.png, as for `segwild bench folder`",
        ))
        .arg(
            number("clicks-per-object", "20", "Clicks on each object, each measured by itself")
                .value_parser(value_parser!(u64)),
        )
        .arg(
            number("click-seed", "1", "Seed of the clicks and of the trainings")
                .value_parser(value_parser!(u64)),
        )
        .arg(flag("boxes", "Draw a box around the object instead of a click"))
        .arg(flag("alternatives", "Measure the alternatives of each answer as well"))
        .arg(flag("boundaries", "Measure each click by one kind of the trees' boundaries alone as well"))
        .arg(
            number("corrections", "0", "Further clicks, each where the answer is most wrong (NoC)")
                .value_parser(value_parser!(u64)),
        )
        .arg(path("out", "Folder for results and page [default: .bench/clicks]"))
        .arg(path("page", "Write the page to this file as well"))
        .arg(json());
    with_settings_in_long_help(command)
}

/// Measures, and writes the page.
pub fn clicks(matches: &ArgMatches) -> Result<(), Failure> {
    let settings = given(matches);
    use_threads(Settings::layered(None, &settings)?.run.threads);
    let options = ClickOptions {
        scenes: matches.get_many("scenes").expect("clap requires it").cloned().collect(),
        sizes: numbers(matches, "sizes")?,
        clicks: *matches.get_one::<u64>("clicks-per-object").expect("it has a default") as usize,
        seed: *matches.get_one::<u64>("click-seed").expect("it has a default"),
        boxes: matches.get_flag("boxes"),
        alternatives: matches.get_flag("alternatives"),
        boundaries: matches.get_flag("boundaries"),
        corrections: *matches.get_one::<u64>("corrections").expect("it has a default") as usize,
        out: path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/clicks")),
        command: command_line(),
        settings,
    };
    let json = matches.get_flag("json");
    let results = random_clicks(&options, |record| {
        let _ = if json { print_json(record) } else { tell(record) };
    })?;
    for what in &results.missing {
        print_warning(&format!("not measured: {what}"));
    }
    let page = write(&options.out, path_of(matches, "page").as_deref(), &results)?;
    if json {
        return Ok(());
    }
    print_line(&format!("page: {}", page.display()))
}

fn tell(record: &Record) -> Result<(), Failure> {
    let iou = record.numbers.get("iou").copied().unwrap_or_default();
    let at = record.notes.first().map_or("", String::as_str);
    print_line(&format!("{} {} click {}: IoU {iou:.3}, {at}", record.scene, record.target, record.prompt))
}
