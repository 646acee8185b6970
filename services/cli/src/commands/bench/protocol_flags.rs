//! What the protocols have in common: rows, seeds, where results go, and how they are printed.

use super::command_line::command_line;
use super::scene_args::{each_of, only};
use crate::args::{
    examples, flag, given, json, list, number, numbers, path, path_of, with_settings_in_long_help,
};
use crate::failure::Failure;
use crate::operators::use_threads;
use crate::output::{print_json, print_line, print_warning};
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use segwild_eval::protocols::tables::{all, page};
use segwild_eval::protocols::{FoundScenes, ProtocolBase, ProtocolError, Table, measure};
use segwild_eval::record::{Provenance, Record, Results};
use segwild_pipeline::{Settings, SettingsError};
use std::path::PathBuf;

/// Adds the flags that every protocol has: those of all settings, `--seeds`, `--only`, `--out`, `--page`, `--json`.
pub fn with_common(command: Command, seeds: &'static str, folder: &'static str) -> Command {
    with_settings_in_long_help(command)
        .arg(each_of(
            "seeds",
            seeds,
            "Seeds, with commas: of synthetic scenes, or of the training on given photos",
        ))
        .arg(only("Rows to compute, with commas, of whichever table [default: all of the table]"))
        .arg(
            Arg::new("change")
                .long("change")
                .value_name("NAME=VALUE")
                .action(ArgAction::Append)
                .help("A setting that holds whatever a row says: to tune a baseline"),
        )
        .arg(path("out", folder))
        .arg(flag(
            "keep",
            "Keep what OUT/results.json has of other rows, scenes and prompts [default: start over]",
        ))
        .arg(path("page", "Write the tables to this file, with what made them"))
        .arg(json())
}

/// The end of the help of a protocol on data that the user has: what they are, where to put them, examples.
pub fn data_and_examples(data: &str, first: &str, second: &str) -> String {
    format!(
        "{data}\ndocs/guide/protocols.md shows the folders; what is missing is named, with where to put it.\n\n{}",
        examples(first, second)
    )
}

/// The folder of a protocol's data.
pub fn root(help: &'static str) -> Arg {
    Arg::new("root").required(true).value_name("ROOT").value_parser(value_parser!(PathBuf)).help(help)
}

/// `--clicks` of protocols that click where true masks are deepest.
pub fn clicks(default: &'static str) -> Arg {
    let help = "Clicks on each reference photo: where its mask is deepest, and then away from there";
    number("clicks", default, help).value_parser(value_parser!(u32).range(1..))
}

/// Adds `--table`.
pub fn with_table(command: Command, default: &'static str) -> Command {
    command.arg(
        Arg::new("table")
            .long("table")
            .value_name("WORD")
            .value_parser(["ablation", "baselines"])
            .default_value(default)
            .help("Rows: one part of the method changed at a time, or other methods"),
    )
}

/// The requested table.
pub fn table(matches: &ArgMatches) -> Table {
    match matches.get_one::<String>("table").map(String::as_str) {
        Some("baselines") => Table::Baselines,
        _ => Table::Ablation,
    }
}

/// The flags that protocols share.
pub struct ProtocolFlags {
    /// Where scenes, runs and results go.
    pub out: PathBuf,
    /// Rows by name; empty for all.
    pub only: Vec<String>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// What all rows have in common.
    pub base: ProtocolBase,
    /// Results so far: none.
    pub results: Results,
    /// Whether to print JSON.
    pub json: bool,
    page: Option<PathBuf>,
}

/// Reads the common flags, and starts a new set of results in the folder.
pub fn flags(matches: &ArgMatches, folder: &str) -> Result<ProtocolFlags, Failure> {
    let out = path_of(matches, "out").unwrap_or_else(|| PathBuf::from(folder));
    let settings = Settings::layered(None, &given(matches))?;
    use_threads(settings.run.threads);
    let mut changes = Vec::new();
    for text in matches.get_many::<String>("change").into_iter().flatten() {
        let (name, value) = text
            .split_once('=')
            .ok_or_else(|| Failure::usage(format!("--change {text}: expected NAME=VALUE, as in tau=0.9")))?;
        Settings::default().set(name, value).map_err(SettingsError::from)?;
        changes.push((name.to_owned(), value.to_owned()));
    }
    std::fs::create_dir_all(&out).map_err(|e| Failure::cannot_write(&out, &e))?;
    let mut results = Results { made: Provenance::here(command_line()), ..Results::default() };
    let (file, photos) = (out.join("results.json"), out.join("photos.jsonl"));
    if matches.get_flag("keep") && file.is_file() {
        let before = Results::read(&file).map_err(ProtocolError::from)?;
        // What is kept was made by another command.
        if before.made.command != results.made.command {
            results.made.command = format!("{} && {}", before.made.command, results.made.command);
        }
        (results.records, results.missing) = (before.records, before.missing);
    } else if photos.is_file() {
        std::fs::remove_file(&photos).map_err(|e| Failure::cannot_write(&photos, &e))?;
    }
    Ok(ProtocolFlags {
        out,
        only: list(matches, "only"),
        seeds: numbers(matches, "seeds")?,
        base: ProtocolBase { settings, changes },
        results,
        json: matches.get_flag("json"),
        page: path_of(matches, "page"),
    })
}

/// Prints a measurement.
pub fn tell(json: bool) -> impl FnMut(&Record) {
    move |record: &Record| {
        let _ = if json {
            print_json(record)
        } else {
            let shown = record.numbers.iter().map(|(name, value)| format!("{name} {value:.3}"));
            let shown: Vec<String> = shown.collect();
            let Record { scene, setting, provider, target, prompt, .. } = record;
            print_line(&format!(
                "{scene} {setting:>20} {provider} {target:>16} {prompt}: {}",
                shown.join(" ")
            ))
        };
    }
}

/// Prints the tables, and writes the page if one is requested.
pub fn finish(flags: &ProtocolFlags, title: &str) -> Result<(), Failure> {
    if let Some(file) = &flags.page {
        let text = page(title, std::slice::from_ref(&flags.results));
        segwild_flow::files::write_plain(file, text).map_err(|e| Failure::cannot_write(file, &e))?;
    }
    if flags.json {
        return Ok(());
    }
    for table in all(&flags.results) {
        print_line(&format!("\n{}", table.trim_end()))?;
    }
    print_line(&format!("\nresults: {}", flags.out.join("results.json").display()))
}

/// Puts the rows through scenes, each made for every seed.
pub fn measure_scenes(
    flags: &mut ProtocolFlags,
    table: Table,
    scenes: impl Fn(&Settings, u64) -> Result<FoundScenes, ProtocolError>,
) -> Result<(), Failure> {
    let rows = table.rows(&flags.only)?;
    let mut report = tell(flags.json);
    for &seed in &flags.seeds {
        let FoundScenes { scenes, missing } = scenes(&flags.base.settings, seed)?;
        flags.results.miss(missing);
        for scene in scenes {
            measure(&flags.out, &scene, &rows, &flags.base, &mut flags.results, &mut report)?;
        }
    }
    // Also where nothing was measured since.
    let file = flags.out.join("results.json");
    flags.results.write(&file).map_err(ProtocolError::from)?;
    for what in &flags.results.missing {
        print_warning(&format!("not measured: {what}"));
    }
    Ok(())
}

/// A setting's default for one benchmark, where the person did not give it.
pub fn default_setting(
    matches: &ArgMatches,
    flags: &mut ProtocolFlags,
    name: &str,
    value: &str,
) -> Result<(), Failure> {
    if given(matches).iter().all(|(given, _)| given != name) {
        flags.base.settings.set(name, value).map_err(SettingsError::from)?;
    }
    Ok(())
}
