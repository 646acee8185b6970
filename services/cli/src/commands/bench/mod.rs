//! `segwild bench`: one module per benchmark, each with its arguments, a call into `segwild_bench`, and words out.

mod chart;
mod compare;
mod flow;
mod scale;
mod slice;
mod stability;
mod synthetic;

use crate::failure::Failure;
use clap::{ArgMatches, Command};
use std::str::FromStr;

/// The command's arguments. Without the name of a benchmark it is `synthetic`.
pub fn command() -> Command {
    synthetic::with_args(Command::new("bench").about("Measure: how accurate, how fast, how steady"))
        .args_conflicts_with_subcommands(true)
        .subcommand(synthetic::command())
        .subcommand(chart::command())
        .subcommand(chart::point_command())
        .subcommand(compare::command())
        .subcommand(flow::command())
        .subcommand(scale::command())
        .subcommand(slice::command())
        .subcommand(stability::command())
}

/// Measures what was asked for.
pub fn bench(matches: &ArgMatches) -> Result<(), Failure> {
    match matches.subcommand() {
        Some(("chart", m)) => chart::chart(m),
        Some(("compare", m)) => compare::compare(m),
        Some(("scale", m)) => scale::scale(m),
        Some(("slice", m)) => slice::slice(m),
        Some(("stability", m)) => stability::stability(m),
        Some(("point", _)) => chart::point(),
        Some(("flow", m)) => flow::flow(m),
        Some(("synthetic", m)) => synthetic::synthetic(m),
        _ => synthetic::synthetic(matches),
    }
}

/// The words of a flag that takes several, with commas between them.
fn list(matches: &ArgMatches, name: &str) -> Vec<String> {
    let text = matches.get_one::<String>(name).map_or("", String::as_str);
    text.split(',').map(str::trim).filter(|t| !t.is_empty()).map(str::to_owned).collect()
}

/// The whole numbers of a flag that takes several, with commas between them.
fn numbers<T: FromStr>(matches: &ArgMatches, name: &str) -> Result<Vec<T>, Failure> {
    let read = |text: String| {
        text.parse()
            .map_err(|_| Failure::usage(format!("--{name} {text}: expected whole numbers with commas")))
    };
    list(matches, name).into_iter().map(read).collect()
}

/// The command line as it was given, by which pages say how they were made.
fn command_line() -> String {
    let words: Vec<String> = std::env::args().skip(1).collect();
    format!("segwild {}", words.join(" "))
}
