//! One module per command: its arguments in, a pipeline call, words out.

pub mod bake;
pub mod batch;
pub mod bench;
pub mod cache;
pub mod demo;
pub mod doctor;
pub mod eval;
pub mod render;
pub mod run;
pub mod segment;
pub mod status;
pub mod top;

use crate::failure::Failure;
use clap::ArgMatches;
use serde::Serialize;
use std::io::Write;
use std::path::PathBuf;

/// A path argument.
pub fn path(matches: &ArgMatches, name: &str) -> Option<PathBuf> {
    matches.get_one::<PathBuf>(name).cloned()
}

/// Prints a value as one line of JSON. A reader that has gone away is no error.
pub fn print_json<T: Serialize>(value: &T) -> Result<(), Failure> {
    let line = serde_json::to_string(value).map_err(std::io::Error::other)?;
    print_line(&line)
}

/// Prints a line on standard output. A reader that has gone away is no error.
pub fn print_line(line: &str) -> Result<(), Failure> {
    match writeln!(std::io::stdout(), "{line}") {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}

/// Uses so many compute threads; 0 for all cores.
pub fn use_threads(threads: u32) {
    // Refused only when the pool is there already, and then it serves.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(threads as usize).build_global();
}
