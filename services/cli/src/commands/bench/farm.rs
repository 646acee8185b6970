//! `segwild bench farm`

use super::command_line::command_line;
use super::scene_args::each_of;
use crate::args::{examples, number, numbers, path, path_of};
use crate::exit;
use crate::failure::Failure;
use crate::output::print_line;
use clap::{ArgMatches, Command, value_parser};
use segwild_bench::farm::{FailureFigures, FarmBenchOptions, page};
use segwild_eval::record::Provenance;
use std::path::PathBuf;

/// The benchmark's arguments.
pub fn command() -> Command {
    let whole = || value_parser!(u32).range(1..);
    Command::new("farm")
        .about("Measure a farm: its log on a real server, and many scenes on simulated machines")
        .after_help(examples(
            "segwild bench farm",
            "segwild bench farm --scene-count 1000 --machines 20 --page farm.md",
        ))
        .arg(path("server", "The nats-server program [default: nats-server]"))
        .arg(number("jobs", "1000", "Jobs of the log that is measured").value_parser(whole()))
        .arg(
            number("kills", "40", "Kills of parts of a small farm, before its network is cut; 0: neither")
                .value_parser(value_parser!(u32)),
        )
        .arg(number("scene-count", "10000", "Simulated scenes").value_parser(whole()))
        .arg(number("machines", "200", "Simulated machines").value_parser(whole()))
        .arg(each_of("seeds", "1,2,3", "Seeds of the simulated farms"))
        .arg(path("out", "Folder for the server's log [default: .bench/farm]"))
        .arg(path("page", "Write the figures to this file, as a page"))
}

/// Measures a farm.
pub fn farm(matches: &ArgMatches) -> Result<(), Failure> {
    let count = |name: &str| *matches.get_one::<u32>(name).expect("it has a default") as usize;
    let options = FarmBenchOptions {
        dir: path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/farm")),
        server: path_of(matches, "server").unwrap_or_else(|| PathBuf::from("nats-server")),
        program: std::env::current_exe()?,
        kills: count("kills"),
        jobs: count("jobs"),
        scenes: count("scene-count"),
        workers: count("machines"),
        seeds: numbers(matches, "seeds")?,
    };
    let failed = |error: segwild_bench::farm::FarmBenchError| Failure {
        message: error.to_string(),
        code: exit::FAILED,
    };
    let figures = segwild_bench::farm::farm(&options, |s| {
        let _ = print_line(&format!(
            "seed {}: {} done, {} dead of {} hopeless, {} lost, {} done twice; {:.3} of the ideal time, {:.1} % busy",
            s.seed, s.done, s.dead, s.hopeless, s.lost, s.completed_twice, s.over_ideal, 100.0 * s.busy
        ));
    })
    .map_err(failed)?;
    match &figures.log {
        None => print_line("no nats-server here: the log was not measured")?,
        Some(log) => {
            let (joined, records) = log.growth.last().map_or((0.0, 0), |l| (l.join_ms, l.records));
            print_line(&format!(
                "{:.0} changes a second by one machine, {:.0} by four; {:.1} µs to fold one; {joined:.0} ms to join after {records} \
                 records",
                log.changes_per_s, log.changes_per_s_of_four, log.fold_us
            ))?;
        }
    }
    let failing = [("killed", &figures.kills), ("cut", &figures.cuts)];
    let failing: Vec<(&str, &FailureFigures)> =
        failing.into_iter().filter_map(|(what, measured)| Some((what, measured.as_ref()?))).collect();
    for (what, f) in &failing {
        print_line(&format!(
            "{what} {:?}: {} of {} scenes differ, {} lost, {} completed twice, in {:.0} s",
            f.failures, f.differing, f.scenes, f.lost, f.completed_twice, f.farm_s
        ))?;
    }
    if let Some(file) = path_of(matches, "page") {
        let made = Provenance::here(command_line());
        segwild_flow::files::write_plain(&file, page(&figures, &options, &made))
            .map_err(|e| Failure::cannot_write(&file, &e))?;
    }
    if let Some((what, f)) = failing.iter().find(|(_, f)| f.wrong() > 0) {
        let (differing, lost, twice) = (f.differing, f.lost, f.completed_twice);
        let message = format!("{what}: {differing} scenes differ, {lost} were lost, {twice} completed twice");
        return Err(Failure { message, code: exit::FAILED });
    }
    match figures.simulated.iter().find(|s| s.lost > 0 || s.completed_twice > 0) {
        None => Ok(()),
        Some(s) => {
            let message =
                format!("seed {}: {} scenes were lost, {} done twice", s.seed, s.lost, s.completed_twice);
            Err(Failure { message, code: exit::FAILED })
        }
    }
}
