//! `segwild top`

use crate::args::flag;
use crate::failure::Failure;
use crate::farm::{target, target_args};
use crate::output::print_line;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_monitor::top as screen;
use std::io::IsTerminal;

/// The command's arguments.
pub fn command() -> Command {
    let size = |name: &'static str, default: &'static str, help: &'static str| {
        Arg::new(name)
            .long(name)
            .value_name("N")
            .default_value(default)
            .value_parser(value_parser!(u16).range(20..=1000))
            .help(help)
    };
    target_args(Command::new("top"))
        .about("Watch a run, a batch or a farm: what it does, how fast, why things wait (q leaves)")
        .after_help(crate::args::examples(
            "segwild top runs/trevi",
            "segwild top runs/night --once --columns 120",
        ))
        .arg(flag("once", "Print one page as text and exit"))
        .arg(size("columns", "80", "Width of the page of --once"))
        .arg(size("rows", "24", "Height of the page of --once"))
}

/// Watches a run or a batch.
pub fn top(matches: &ArgMatches) -> Result<(), Failure> {
    let target = target(matches)?;
    let number = |name: &str| *matches.get_one::<u16>(name).expect("it has a default");
    if matches.get_flag("once") {
        return print_line(&screen::frame(&target.view()?, number("columns"), number("rows")));
    }
    if !std::io::stdout().is_terminal() {
        return Err(Failure::usage("`top` needs a terminal; `top --once` prints one page as text"));
    }
    Ok(screen::follow(&target)?)
}
