//! `segwild bench slice`

use super::command_line::command_line;
use crate::args::{examples, given, path, path_of, with_settings_in_long_help};
use crate::exit;
use crate::failure::Failure;
use crate::operators::use_threads;
use crate::output::print_line;
use clap::{ArgMatches, Command};
use segwild_bench::slice::slice as measure;
use segwild_pipeline::Settings;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    let command = Command::new("slice")
        .about(
            "Quality and counted work on two tiny scenes, for `bench compare --strict` against what is kept",
        )
        .after_help(examples("segwild bench slice", "segwild bench slice --out slice.json"))
        .arg(path("out", "File for the results [default: .bench/slice.json]"));
    with_settings_in_long_help(command)
}

/// Measures and writes the results.
pub fn slice(matches: &ArgMatches) -> Result<(), Failure> {
    let file = path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/slice.json"));
    let changes = given(matches);
    use_threads(Settings::layered(None, &changes)?.run.threads);
    let folder = file.with_extension("runs");
    let results = measure(&folder, &changes, command_line())?;
    let _ = std::fs::remove_dir_all(&folder);
    results.write(&file).map_err(|e| Failure { message: e.to_string(), code: exit::FOLDER })?;
    print_line(&format!("{} records: {}", results.records.len(), file.display()))
}
