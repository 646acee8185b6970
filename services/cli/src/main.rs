//! The `segwild` program: reads the command line, calls the crates below, prints what happened in words.
//!
//! - `commands/`: a file per command, with its arguments, the call, and what it prints. Flags of settings are made from the
//!   settings themselves (`args.rs`).
//! - `failure.rs`: the errors of all crates as one sentence and one exit code; `exit.rs` has the codes.
//! - `progress.rs`, `output.rs`: bars and sentences for a person, JSON lines for a program.
//!
//! It computes nothing, and no other crate can call it: what a command does is in the crate that it calls, most of it in
//! [`segwild_pipeline`].
//!
//! ```sh
//! segwild run photos/trevi --out runs/trevi
//! segwild segment runs/trevi --photo a.jpg --positive 640,420 --name oceanus
//! echo $?     # 0, or one of `segwild --help`
//! ```
//!
//! Start reading at `commands/mod.rs`, then `commands/run.rs`.

mod allocator;
mod args;
mod commands;
mod exit;
mod failure;
mod farm;
mod operators;
mod output;
mod progress;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use segwild_farm::FarmAddressError;
use std::process::ExitCode;

/// Whether the innermost command is to print JSON.
fn wants_json(matches: &clap::ArgMatches) -> bool {
    match matches.subcommand() {
        Some((_, inner)) => wants_json(inner),
        None => matches.try_get_one::<bool>("json").ok().flatten().copied().unwrap_or(false),
    }
}

/// Whether a command line that was refused is to be answered in JSON.
fn wants_json_by_words(words: &[String]) -> bool {
    words.iter().take_while(|word| *word != "--").any(|word| word == "--json")
}

/// Prints a mistake on the command line, for a program as well where one of the words requests that.
fn misused(failure: &failure::Failure, words: &[String]) -> ExitCode {
    failure.tell();
    if wants_json_by_words(words) {
        // Nobody listening: the exit code says it, too.
        let _ = output::print_json(&failure.to_json());
    }
    ExitCode::from(failure.code)
}

/// What clap says is wrong with a command line: one line, without its advice.
fn in_one_line(error: &clap::Error) -> String {
    let whole = error.render().to_string();
    let sentence = whole.split("\n\n").next().unwrap_or_default();
    let words: Vec<&str> = sentence.trim_start_matches("error:").split_whitespace().collect();
    words.join(" ")
}

/// Prints why a command line was refused, or the help that was wanted. A flag of an earlier version is answered with the
/// present one.
fn refused(error: &clap::Error, words: &[String]) -> ExitCode {
    let flag = match error.get(ContextKind::InvalidArg) {
        Some(ContextValue::String(flag)) if error.kind() == ErrorKind::UnknownArgument => flag.as_str(),
        _ => "",
    };
    if let Some(sentence) = commands::renamed(words, flag) {
        return misused(&failure::Failure::usage(sentence), words);
    }
    // The value itself would be printed, with its password.
    let source = std::error::Error::source(error).and_then(|e| e.downcast_ref::<FarmAddressError>());
    if let Some(secret @ FarmAddressError::Secret) = source {
        return misused(&failure::Failure::usage(secret.to_string()), words);
    }
    let _ = error.print();
    if !error.use_stderr() {
        return ExitCode::from(exit::OK);
    }
    if wants_json_by_words(words) {
        let _ = output::print_json(&failure::Failure::usage(in_one_line(error)).to_json());
    }
    ExitCode::from(exit::USAGE)
}

fn main() -> ExitCode {
    allocator::share_heaps();
    // A layer of Mesa asks the desktop which GPU it draws on, and complains on stderr where there is none. The order
    // of adapters is our own (`segwild_gpu::adapters`).
    // SAFETY: no other thread runs yet.
    unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    let words: Vec<String> = std::env::args_os().skip(1).map(|w| w.to_string_lossy().into_owned()).collect();
    if let Some(sentence) = commands::renamed_value(&words) {
        return misused(&failure::Failure::usage(sentence), &words);
    }
    let matches = match commands::program().try_get_matches() {
        Ok(matches) => matches,
        Err(error) => return refused(&error, &words),
    };
    let level = std::env::var("SEGWILD_LOG").unwrap_or_else(|_| "error".into());
    // What a person should know is an event; the log is for those who want more.
    let filter = tracing_subscriber::EnvFilter::try_new(&level).unwrap_or_else(|_| "error".into());
    // A log that cannot be written, as on a full disk, is no reason to end.
    let log = tracing_subscriber::fmt().log_internal_errors(false);
    log.with_env_filter(filter).with_writer(std::io::stderr).init();
    let faults: Vec<&String> = matches.get_many("fault").into_iter().flatten().collect();
    if let Err(error) = segwild_flow::fault::arm(&faults) {
        failure::Failure::usage(error.to_string()).tell();
        return ExitCode::from(exit::USAGE);
    }
    match commands::run(&matches) {
        Ok(()) => ExitCode::from(exit::OK),
        Err(failure) => {
            failure.tell();
            if wants_json(&matches) {
                // Nobody listening: the exit code says it, too.
                let _ = output::print_json(&failure.to_json());
            }
            ExitCode::from(failure.code)
        }
    }
}
