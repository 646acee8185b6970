//! `segwild cache`

use super::{path, print_json, print_line};
use crate::exit;
use crate::failure::Failure;
use clap::ArgMatches;
use segwild_pipeline::{RunFolder, cache_gc, cache_list, cache_verify};

/// Lists, verifies or sweeps a run's cache.
pub fn cache(matches: &ArgMatches) -> Result<(), Failure> {
    let (what, matches) = matches.subcommand().expect("clap requires one");
    let folder = RunFolder::open(&path(matches, "run").expect("clap requires it"))?;
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

fn list(folder: &RunFolder, json: bool) -> Result<(), Failure> {
    let lines = cache_list(folder)?;
    if json {
        return lines.iter().try_for_each(print_json);
    }
    for l in &lines {
        let spare = match l.files - l.used {
            0 => String::new(),
            n => format!("; {n} ({}) of other settings", size(l.bytes - l.used_bytes)),
        };
        print_line(&format!("{:>10}  {:>6} files  {:>10}{spare}", l.kind, l.files, size(l.bytes)))?;
    }
    let (files, bytes) = lines.iter().fold((0, 0), |(f, b), l| (f + l.files, b + l.bytes));
    print_line(&format!("{:>10}  {files:>6} files  {:>10}", "all", size(bytes)))
}

fn verify(folder: &RunFolder, json: bool) -> Result<(), Failure> {
    let mut damaged = Vec::new();
    let all = cache_verify(folder, |artefact, reason| damaged.push((artefact.key(), reason.to_owned())))?;
    if json {
        let list: Vec<_> =
            damaged.iter().map(|(key, reason)| serde_json::json!({ "key": key, "reason": reason })).collect();
        print_json(&serde_json::json!({ "files": all, "damaged": list }))?;
    } else {
        for (key, reason) in &damaged {
            print_line(&format!("damaged  {key}: {reason}"))?;
        }
        print_line(&format!("{all} files, {} damaged", damaged.len()))?;
    }
    match damaged.len() {
        0 => Ok(()),
        n => Err(Failure {
            message: format!(
                "{n} of {all} files were damaged and moved to {}; `segwild run` makes them anew",
                folder.path().join("cache/corrupt").display()
            ),
            code: exit::FOLDER,
        }),
    }
}

fn size(bytes: u64) -> String {
    match bytes {
        0..1024 => format!("{bytes} B"),
        1024..1_048_576 => format!("{:.1} KiB", bytes as f64 / 1024.0),
        _ => format!("{:.1} MiB", bytes as f64 / 1_048_576.0),
    }
}
