//! `segwild bench studio`

use super::command_line::command_line;
use crate::args::{examples, path, path_of};
use crate::exit;
use crate::failure::Failure;
use crate::output::print_line;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_bench::studio::{StudioRow, StudioTarget, page, studio as measure, write};
use segwild_eval::record::{Provenance, Results};
use segwild_monitor::view::RunView;
use segwild_studio::messages::ANSWER_LABEL;
use segwild_studio::{ServeOptions, serve};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The benchmark's arguments.
pub fn command() -> Command {
    Command::new("studio")
        .about("What a person waits for on the page: photos, candidates, answers, frames; and its memory")
        .arg(
            Arg::new("runs")
                .required(true)
                .num_args(1..)
                .value_name("RUN")
                .value_parser(value_parser!(PathBuf))
                .help("Trained runs"),
        )
        .arg(path("out", "Folder for results [default: .bench/studio]"))
        .arg(path("page", "Write the page to this file as well"))
        .after_help(examples(
            "segwild bench studio runs/trevi",
            "segwild bench studio runs/trevi --page studio.md",
        ))
}

/// Measures each run, and prints the page.
pub fn studio(matches: &ArgMatches) -> Result<(), Failure> {
    let out = path_of(matches, "out").unwrap_or_else(|| PathBuf::from(".bench/studio"));
    let mut results = Results { made: Provenance::here(command_line()), ..Results::default() };
    for run in matches.get_many::<PathBuf>("runs").expect("clap requires it") {
        // Runs of two folders may have one name: each is measured.
        results.records.push(row(run)?.record());
        write(&out, &results)?;
    }
    let text = page(&results);
    if let Some(file) = path_of(matches, "page") {
        segwild_flow::files::write_plain(&file, &text).map_err(|e| Failure::cannot_write(&file, &e))?;
    }
    print_line(text.trim_end())
}

/// Serves a run in this process, and measures it.
fn row(run: &Path) -> Result<StudioRow, Failure> {
    let name = run.canonicalize()?.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let started = Instant::now();
    let server = serve(run, ServeOptions::default())?;
    let target = StudioTarget {
        address: server.socket(),
        token: server.token().text().to_owned(),
        run: name.clone(),
        answer_label: ANSWER_LABEL,
        started,
    };
    let figures = measure(&target).map_err(|e| Failure { message: e.to_string(), code: exit::FAILED })?;
    let own = RunView::read(run, 0.0).ok().and_then(|view| view.peak_rss_bytes);
    Ok(StudioRow { run: name, figures, memory: [segwild_flow::cpu::peak_memory(), own] })
}
