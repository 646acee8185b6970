//! What the protocols have in common: rows, seeds, where results go, and how they are printed.

use super::{list, numbers};
use crate::args::{given, json, path, with_settings_in_long_help};
use crate::commands::{path as path_of, print_json, print_line, use_threads};
use crate::exit;
use crate::failure::Failure;
use clap::builder::{PossibleValue, PossibleValuesParser};
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use segwild_bench::page::PageError;
use segwild_bench::point::PointError;
use segwild_eval::protocols::folder::{Parts, read_parts};
use segwild_eval::protocols::tables::{all, page};
use segwild_eval::protocols::{FoundScenes, ProtocolBase, ProtocolError, Table, measure};
use segwild_eval::record::{Provenance, Record, Results};
use segwild_eval::trial::ProviderKind;
use segwild_gpu::GpuError;
use segwild_pipeline::{Settings, SettingsError};
use segwild_scene::settings::Value;
use segwild_synthetic::LightVariation;
use std::path::{Path, PathBuf};

/// The arguments of a benchmark that trains scenes by itself: their folders, and `--sizes`.
pub fn scenes_and_sizes(scenes: &'static str) -> [Arg; 2] {
    let folders = Arg::new("scenes").value_name("SCENE").num_args(1..).required(true);
    [
        folders.value_parser(value_parser!(PathBuf)).help(scenes),
        Arg::new("sizes")
            .long("sizes")
            .value_name("LIST")
            .default_value("320")
            .help("Long sides of the photos in pixels, with commas"),
    ]
}

/// Adds the flags that every protocol has: those of all settings, `--seeds`, `--only`, `--out`, `--page`, `--json`.
pub fn with_common(command: Command, seeds: &'static str, folder: &'static str) -> Command {
    with_settings_in_long_help(command)
        .arg(
            Arg::new("seeds")
                .long("seeds")
                .value_name("LIST")
                .default_value(seeds)
                .help("Seeds, with commas: of synthetic scenes, or of the training on given photos"),
        )
        .arg(
            Arg::new("only")
                .long("only")
                .value_name("LIST")
                .help("Rows to compute, with commas, of whichever table [default: all of the table]"),
        )
        .arg(
            Arg::new("change")
                .long("change")
                .value_name("NAME=VALUE")
                .action(ArgAction::Append)
                .help("A setting that holds whatever a row says: to tune a baseline"),
        )
        .arg(path("out", folder))
        .arg(
            Arg::new("keep").long("keep").action(ArgAction::SetTrue).help(
                "Keep what OUT/results.json has of other rows, scenes and prompts [default: start over]",
            ),
        )
        .arg(path("page", "Write the tables to this file, with what made them"))
        .arg(json())
}

/// `--light` of synthetic scenes.
pub fn light() -> Arg {
    Arg::new("light")
        .long("light")
        .value_parser(PossibleValuesParser::new(LightVariation::CHOICES))
        .default_value("mixed")
        .help("What differs from photo to photo of a synthetic scene")
}

/// What [`light`] was given.
pub fn light_of(matches: &ArgMatches) -> Result<LightVariation, Failure> {
    LightVariation::read(matches.get_one::<String>("light").expect("it has a default"))
        .map_err(Failure::usage)
}

/// `--providers` of synthetic scenes.
pub fn providers() -> Arg {
    let choices = [
        PossibleValue::new("builtin")
            .alias("built-in")
            .help("What the settings name, as a user has it: the built-in provider, or networks"),
        PossibleValue::new("oracle")
            .help("The truth with faults: tests the 3D part alone, and no user has it"),
    ];
    Arg::new("providers")
        .long("providers")
        .value_parser(PossibleValuesParser::new(choices))
        .default_value("builtin")
        .help("Who makes the masks of synthetic photos")
}

/// What [`providers`] was given.
pub fn providers_of(matches: &ArgMatches) -> ProviderKind {
    match matches.get_one::<String>("providers").map(String::as_str) {
        Some("oracle") => ProviderKind::Oracle,
        _ => ProviderKind::Builtin,
    }
}

/// `--parts` of an object on given photos.
pub fn parts() -> Arg {
    path("parts", "JSON file of the rows at which an object's parts meet, by photo: one click into each part")
}

/// What [`parts`] was given; none otherwise.
pub fn parts_of(matches: &ArgMatches) -> Result<Parts, ProtocolError> {
    path_of(matches, "parts").map_or_else(|| Ok(Parts::new()), |file| read_parts(&file))
}

/// Adds `--table`.
pub fn with_table(command: Command, default: &'static str) -> Command {
    command.arg(
        Arg::new("table")
            .long("table")
            .value_parser(["ablation", "baselines"])
            .default_value(default)
            .help("Rows: one part of the method changed at a time, or other methods"),
    )
}

/// The table that was asked for.
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
    std::fs::create_dir_all(&out).map_err(|e| cannot_write(&out, &e))?;
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
        std::fs::remove_file(&photos).map_err(|e| cannot_write(&photos, &e))?;
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

/// The command as it was given, without the folder of the program and what only says where the output goes.
pub fn command_line() -> String {
    let mut words = vec!["segwild".to_owned()];
    let mut given = std::env::args().skip(1);
    while let Some(word) = given.next() {
        if word == "--out" || word == "--page" {
            given.next();
        } else if !["--out=", "--page="].iter().any(|p| word.starts_with(p))
            && word != "--json"
            && word != "--keep"
        {
            words.push(word);
        }
    }
    words.join(" ")
}

pub fn cannot_write(file: &Path, error: &std::io::Error) -> Failure {
    Failure { message: format!("cannot write {}: {error}", file.display()), code: exit::of_system(error) }
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

/// Prints the tables, and writes the page if one was asked for.
pub fn finish(flags: &ProtocolFlags, title: &str) -> Result<(), Failure> {
    if let Some(file) = &flags.page {
        let text = page(title, std::slice::from_ref(&flags.results));
        segwild_flow::files::write_plain(file, text).map_err(|e| cannot_write(file, &e))?;
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
        eprintln!("warning: not measured: {what}");
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

impl From<PointError> for Failure {
    fn from(error: PointError) -> Failure {
        match error {
            PointError::Trial(e) => e.into(),
            PointError::NoTruth(_) => Failure { message: error.to_string(), code: exit::INPUT },
            PointError::Child(_) => Failure { message: error.to_string(), code: exit::FAILED },
        }
    }
}

impl From<PageError> for Failure {
    fn from(error: PageError) -> Failure {
        match error {
            PageError::Settings(e) => e.into(),
            PageError::Point(e) => e.into(),
            PageError::Protocol(e) => e.into(),
            PageError::Unknown { .. } | PageError::Gpu(GpuError::NoAdapter(_)) => {
                Failure::usage(error.to_string())
            }
            PageError::Other(_) | PageError::Record(_) => {
                Failure { message: error.to_string(), code: exit::FOLDER }
            }
            PageError::Io { ref source, .. } => {
                Failure { message: error.to_string(), code: exit::of_system(source) }
            }
            PageError::Plot(_) | PageError::Raster(_) | PageError::Gpu(_) => {
                Failure { message: error.to_string(), code: exit::FAILED }
            }
        }
    }
}
