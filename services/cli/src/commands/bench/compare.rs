//! `segwild bench compare`

use crate::args::{flag, json};
use crate::exit;
use crate::failure::Failure;
use crate::output::{print_json, print_line, print_warning};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::compare::{Change, CompareOptions, compare as compare_all, names_its_provider};
use segwild_eval::record::Results;
use std::path::PathBuf;

/// The command's arguments.
pub fn command() -> Command {
    let file = |name: &'static str, form: &'static str, help: &'static str| {
        Arg::new(name).required(true).value_name(form).value_parser(value_parser!(PathBuf)).help(help)
    };
    Command::new("compare")
        .about("What got better or worse between two results.json, beyond the noise")
        .after_help(
            "A number has changed when its mean differs by more than what matters (IoU 0.005, PSNR 0.1 dB, CPU time 10 %, \
             memory 5 %, counted work 2 %), and a paired t-test over trainings says at 5 % that this is no noise (Holm's \
             correction for how many numbers are tested). With fewer than three pairs the difference must be twice what \
             matters.\n\nExamples:\n  segwild bench compare before/results.json after/results.json\n  \
             segwild bench compare --fail before/results.json after/results.json",
        )
        .arg(file("old", "OLD", "Results before"))
        .arg(file("new", "NEW", "Results after"))
        .arg(flag("fail", "End with exit code 7 if anything got worse, or is no longer measured"))
        .arg(flag(
            "strict",
            "Compare by what matters alone: for fixed seeds, where the same code gives the same bytes",
        ))
        .arg(
            Arg::new("margins")
                .long("margins")
                .value_name("X")
                .value_parser(value_parser!(f64))
                .default_value("1")
                .help("Factor on all differences that matter"),
        )
        .arg(flag("all", "Also list what has not changed"))
        .arg(json())
}

/// Compares, and fails on a change with `--fail`.
pub fn compare(matches: &ArgMatches) -> Result<(), Failure> {
    let read = |name: &str| {
        let file = matches.get_one::<PathBuf>(name).expect("clap requires it");
        Results::read(file).map_err(|e| Failure { message: e.to_string(), code: exit::INPUT })
    };
    let (old, new) = (read("old")?, read("new")?);
    let margins = *matches.get_one::<f64>("margins").expect("it has a default");
    for (which, results) in [("old", &old), ("new", &new)] {
        if !names_its_provider(results) {
            print_warning(&format!(
                "the {which} results do not say who made their masks: they may not compare"
            ));
        }
    }
    let options = CompareOptions { strict: matches.get_flag("strict"), margins };
    let lines = compare_all(&old, &new, options)
        .map_err(|e| Failure { message: e.to_string(), code: exit::INPUT })?;
    if lines.is_empty() {
        return Err(Failure {
            message: "the old results hold no number that is good or bad: there is nothing to compare".into(),
            code: exit::INPUT,
        });
    }
    let count = |change: Change| lines.iter().filter(|l| l.change == change).count();
    for line in lines.iter().filter(|l| l.change != Change::Same || matches.get_flag("all")) {
        if matches.get_flag("json") { print_json(line)? } else { print_line(&line.to_string())? }
    }
    let (worse, missing) = (count(Change::Worse), count(Change::Missing));
    let words = format!(
        "{worse} worse, {missing} missing, {} better, {} the same",
        count(Change::Better),
        count(Change::Same)
    );
    if !matches.get_flag("json") {
        print_line(&words)?;
    }
    if matches.get_flag("fail") && worse + missing > 0 {
        return Err(Failure { message: words, code: exit::WORSE });
    }
    Ok(())
}
