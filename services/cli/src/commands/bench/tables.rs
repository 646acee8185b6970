//! `segwild bench tables`

use crate::args::{examples, path, path_of};
use crate::failure::Failure;
use crate::output::print_line;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::protocols::ProtocolError;
use segwild_eval::protocols::tables::page;
use segwild_eval::record::Results;
use std::path::PathBuf;

/// The command's arguments.
pub fn command() -> Command {
    Command::new("tables")
        .about("Print the tables of results that are there, or write them as one page")
        .after_help(examples(
            "segwild bench tables .bench/synthetic/results.json",
            "segwild bench tables a/results.json b/results.json --page both.md",
        ))
        .arg(
            Arg::new("results")
                .required(true)
                .value_name("RESULTS")
                .num_args(1..)
                .value_parser(value_parser!(PathBuf))
                .help("Files results.json that benchmarks left"),
        )
        .arg(
            Arg::new("title")
                .long("title")
                .value_name("TEXT")
                .default_value("Measured")
                .help("Title of the page"),
        )
        .arg(path("page", "Write the tables to this file, with what made them [default: print them]"))
}

/// Prints or writes the tables.
pub fn tables(matches: &ArgMatches) -> Result<(), Failure> {
    let files = matches.get_many::<PathBuf>("results").into_iter().flatten();
    let sets: Vec<Results> =
        files.map(|file| Results::read(file).map_err(ProtocolError::from)).collect::<Result<_, _>>()?;
    let text = page(matches.get_one::<String>("title").expect("it has a default"), &sets);
    match path_of(matches, "page") {
        Some(file) => {
            segwild_flow::files::write_plain(&file, text).map_err(|e| Failure::cannot_write(&file, &e))
        }
        None => print_line(text.trim_end()),
    }
}
