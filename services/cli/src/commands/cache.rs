//! `segwild cache`

use crate::args::{self, examples, flag, json, number, path_of};
use crate::exit;
use crate::failure::Failure;
use crate::farm::{connect_to, farm_args, reach};
use crate::output::{print_json, print_line};
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use segwild_farm::{FarmAddress, FarmSweep, JobEngine, LEAST_AGE, NatsEngine, StoredArtefact};
use segwild_pipeline::{
    DamagedFile, RunError, RunFolder, cache_gc, cache_list, cache_verify, verify_selections,
};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// The command's arguments.
pub fn command() -> Command {
    let limit = number("limit", "0", "Remove the oldest first, and only until the cache holds this many MiB")
        .value_parser(value_parser!(u64));
    Command::new("cache")
        .about("Look after a run's cache of per-photo results, and a farm's artefacts")
        .subcommand_required(true)
        .after_help(examples("segwild cache ls runs/trevi", "segwild cache gc runs/trevi --dry-run"))
        .subcommand(
            Command::new("ls")
                .about("List what is there, and what the run uses of it")
                .arg(args::run())
                .arg(json())
                .after_help(examples("segwild cache ls runs/trevi", "segwild cache ls runs/trevi --json")),
        )
        .subcommand(
            Command::new("verify")
                .about("Read every file and compare its hash; damaged files are moved aside and recomputed")
                .arg(args::run())
                .arg(json())
                .after_help(examples(
                    "segwild cache verify runs/trevi",
                    "segwild cache verify runs/trevi --json",
                )),
        )
        .subcommand(
            Command::new("gc")
                .about("Remove what other settings than the run's present ones made")
                .arg(args::run())
                .arg(limit)
                .arg(dry_run())
                .arg(json())
                .after_help(examples(
                    "segwild cache gc runs/trevi",
                    "segwild cache gc runs/trevi --limit 500 --dry-run",
                )),
        )
        .subcommand(farm_gc_command())
}

fn farm_gc_command() -> Command {
    let hours = LEAST_AGE.as_secs() / 3600;
    let command =
        Command::new("farm-gc").about("Remove from a farm's artefacts what none of its scenes refers to");
    farm_args(command, "Farm whose artefacts these are: nats://HOST:PORT/NAME")
        .mut_arg("farm", |farm| farm.required(true))
        .arg(
            Arg::new("also")
                .long("also")
                .value_name("FARM")
                .value_parser(str::parse::<FarmAddress>)
                .action(ArgAction::Append)
                .help("Another farm with the same store and key; what it needs stays, too"),
        )
        .arg(
            number("older-than", "72", "Only what was stored so many hours ago; 24 at least")
                .value_parser(value_parser!(u64).range(hours..=1_000_000)),
        )
        .arg(dry_run())
        .arg(json())
        .after_help(examples(
            "segwild cache farm-gc --farm nats://queue:4222/night --dry-run",
            "segwild cache farm-gc --farm nats://queue/night --artefacts s3://scenes --also nats://queue/day",
        ))
}

fn dry_run() -> Arg {
    flag("dry-run", "Remove nothing, print what would go")
}

/// Lists, verifies or sweeps a run's cache.
pub fn cache(matches: &ArgMatches) -> Result<(), Failure> {
    let (what, matches) = matches.subcommand().expect("clap requires one");
    if what == "farm-gc" {
        return farm_gc(matches);
    }
    let folder = RunFolder::open(&path_of(matches, "run").expect("clap requires it"))?;
    let json = matches.get_flag("json");
    match what {
        "ls" => list(&folder, json),
        "verify" => verify(&folder, json),
        _ => {
            let limit = matches.get_one::<u64>("limit").expect("it has a default") << 20;
            let pretend = matches.get_flag("dry-run");
            let swept = cache_gc(&folder, limit, pretend)?;
            if json {
                return print_json(&swept);
            }
            let verb = if pretend { "would be removed" } else { "removed" };
            print_line(&format!("{} files, {}, {verb}", swept.files, size(swept.bytes)))
        }
    }
}

/// Sweeps the artefacts of a farm.
fn farm_gc(matches: &ArgMatches) -> Result<(), Failure> {
    let farm = reach(matches, "sweep")?.expect("clap requires --farm");
    let also = matches.get_many::<FarmAddress>("also").into_iter().flatten();
    let others: Vec<Arc<NatsEngine>> =
        also.map(|address| connect_to(address, matches, "sweep")).collect::<Result<_, _>>()?;
    let hours = *matches.get_one::<u64>("older-than").expect("it has a default");
    let (pretend, json) = (matches.get_flag("dry-run"), matches.get_flag("json"));
    let sweep = FarmSweep {
        farms: [&farm.engine].into_iter().chain(&others).map(named).collect(),
        artefacts: &farm.artefacts,
        older_than: Duration::from_secs(hours * 3600),
        dry_run: pretend,
    };
    let mut report = Ok(());
    let swept = sweep.sweep(&mut |artefact| {
        // Nobody listening is no reason to stop.
        if report.is_ok() && json {
            report = print_json(artefact);
        } else if report.is_ok() && pretend {
            report = print_line(&in_words(artefact));
        }
    })?;
    report?;
    if json {
        return print_json(&serde_json::json!({ "dry_run": pretend, "summary": swept }));
    }
    if swept.missing > 0 {
        print_line(&format!("{} folders that scenes refer to are not in the store", swept.missing))?;
    }
    print_line(&format!(
        "{} artefacts, {}, {}; {} are in use, {} are younger than {hours} h",
        swept.removed.artefacts,
        size(swept.removed.bytes),
        if pretend { "would be removed" } else { "removed" },
        swept.used.artefacts,
        swept.young.artefacts
    ))
}

/// A farm with its name for people.
fn named(engine: &Arc<NatsEngine>) -> (String, &dyn JobEngine) {
    (engine.address().to_string(), &**engine as &dyn JobEngine)
}

fn in_words(artefact: &StoredArtefact) -> String {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_secs());
    let hours = now.saturating_sub(artefact.since) / 3600;
    format!("{}  {:>10}  stored {hours} h ago", artefact.digest, size(artefact.bytes))
}

fn list(folder: &RunFolder, json: bool) -> Result<(), Failure> {
    let lines = cache_list(folder)?;
    if json {
        return lines.iter().try_for_each(print_json);
    }
    for l in &lines {
        let unused = match l.files - l.used {
            0 => String::new(),
            n => format!("; {n} ({}) of other settings", size(l.bytes - l.used_bytes)),
        };
        print_line(&format!("{:>10}  {:>6} files  {:>10}{unused}", l.kind, l.files, size(l.bytes)))?;
    }
    let (files, bytes) = lines.iter().fold((0, 0), |(f, b), l| (f + l.files, b + l.bytes));
    print_line(&format!("{:>10}  {files:>6} files  {:>10}", "all", size(bytes)))
}

fn verify(folder: &RunFolder, json: bool) -> Result<(), Failure> {
    let mut damaged = Vec::new();
    let cached = cache_verify(folder, |artefact, reason| damaged.push((artefact.key(), reason.to_owned())))?;
    let (selected, changed) = verify_selections(folder);
    let (written, masks) = folder.verify_transient_masks()?;
    let (kept, records) = folder.verify_records();
    let all = cached + selected + written + kept;
    if json {
        let list: Vec<_> =
            damaged.iter().map(|(key, reason)| serde_json::json!({ "key": key, "reason": reason })).collect();
        let named = |files: &[(PathBuf, String)]| -> Vec<serde_json::Value> {
            files.iter().map(|(file, reason)| serde_json::json!({ "file": file, "reason": reason })).collect()
        };
        print_json(&serde_json::json!({
            "files": all, "damaged": list, "selections": changed, "transient_masks": named(&masks),
            "records": named(&records)
        }))?;
    } else {
        for (key, reason) in &damaged {
            print_line(&format!("damaged  {key}: {reason}"))?;
        }
        for DamagedFile { file, reason, .. } in &changed {
            print_line(&format!("damaged  {}: {reason}", file.display()))?;
        }
        for (file, reason) in masks.iter().chain(&records) {
            print_line(&format!("damaged  {}: {reason}", file.display()))?;
        }
        let wrong = damaged.len() + changed.len() + masks.len() + records.len();
        print_line(&format!("{all} files, {wrong} damaged"))?;
    }
    let mut messages = Vec::new();
    if !damaged.is_empty() {
        messages.push(format!(
            "{} of {cached} files were damaged and moved to {}; `segwild run` computes them again",
            damaged.len(),
            folder.path().join("cache/corrupt").display()
        ));
    }
    if !masks.is_empty() {
        messages.push(format!(
            "{} of {written} transient masks are damaged; `segwild run` moves them aside and computes them again",
            masks.len()
        ));
    }
    for (file, _) in &records {
        messages.push(format!("{} is damaged: delete it and run again", file.display()));
    }
    // A sentence for each selection: the command that makes it again.
    let mut again: Vec<DamagedFile> = changed;
    again.dedup_by(|a, b| a.selection == b.selection);
    messages.extend(again.into_iter().map(|file| RunError::from(file).to_string()));
    match messages.is_empty() {
        true => Ok(()),
        false => Err(Failure { message: messages.join("; "), code: exit::FOLDER }),
    }
}

fn size(bytes: u64) -> String {
    match bytes {
        0..1024 => format!("{bytes} B"),
        1024..1_048_576 => format!("{:.1} KiB", bytes as f64 / 1024.0),
        _ => format!("{:.1} MiB", bytes as f64 / 1_048_576.0),
    }
}
