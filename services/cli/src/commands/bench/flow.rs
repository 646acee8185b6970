//! `segwild bench flow`

use super::command_line::command_line;
use super::scene_args::{each_of, only};
use crate::args::{examples, json, list, number, numbers, path, path_of};
use crate::failure::Failure;
use crate::output::{print_json, print_line};
use clap::{ArgMatches, Command, value_parser};
use segwild_bench::flow::{FlowOptions, Row, measured, over, page};
use segwild_eval::record::Provenance;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    Command::new("flow")
        .about("Measure what the dataflow promises: overlap, accelerator, remote, cost, cache, kills, memory")
        .after_help(examples("segwild bench flow", "segwild bench flow --page flow.md"))
        .arg(only("Rows to measure, with commas [default: all]"))
        .arg(number("kills", "50", "Runs that are killed").value_parser(value_parser!(u32).range(1..)))
        .arg(each_of("photo-counts", "100,1000", "Photos of the two scenes whose memory is compared"))
        .arg(path("out", "Folder for scenes and runs [default: .bench/flow]"))
        .arg(path(
            "page",
            "Write the table to this file, as a page; rows not measured now are as they were last",
        ))
        .arg(json())
}

/// Prints the ratios that the dataflow promises.
pub fn flow(matches: &ArgMatches) -> Result<(), Failure> {
    let json = matches.get_flag("json");
    let [few, many] = numbers(matches, "photo-counts")?[..] else {
        return Err(Failure::usage("--photo-counts: expected two numbers with a comma, as in 100,1000"));
    };
    let options = FlowOptions {
        dir: path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/flow")),
        program: std::env::current_exe()?,
        only: list(matches, "only"),
        kills: *matches.get_one::<u32>("kills").expect("it has a default") as usize,
        photos: [few, many],
    };
    let report = |row: &Row| {
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
    let rows = segwild_bench::flow::flow(&options, report)?;
    if let Some(file) = path_of(matches, "page") {
        let made = Provenance::here(command_line());
        segwild_flow::files::write_plain(&file, page(&measured(&options.dir), &made))
            .map_err(|e| Failure::cannot_write(&file, &e))?;
    }
    match over(&rows) {
        None => Ok(()),
        Some(message) => Err(Failure { message, code: crate::exit::FAILED }),
    }
}
