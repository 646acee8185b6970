//! `segwild worker`

use super::batch::{BatchOutput, stop_on_presses};
use crate::args::{self, examples, flag, number, path_of};
use crate::exit;
use crate::failure::Failure;
use crate::farm::{farm_args, reach};
use crate::operators::have_files_to_open;
use crate::output::print_note;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_farm::{Needs, WorkerTerms, usual_budget, work};
use std::path::Path;
use std::time::Duration;

/// The command's arguments.
pub fn command() -> Command {
    let command = Command::new("worker").about("Work on the scenes of a farm, until stopped");
    farm_args(command, "Farm: nats://HOST:PORT/NAME, or tls://")
        .mut_arg("farm", |farm| farm.required(true))
        .arg(args::path("work", "Folder on a local disk, for this worker alone [default: runs/worker]"))
        .arg(
            Arg::new("needs")
                .long("needs")
                .value_name("LIST")
                .value_parser(needs)
                .help("Take scenes with at most these needs, as cores=8,memory=64,accelerators=1,gpu=h100 (GiB)"),
        )
        .arg(
            Arg::new("least-free")
                .long("least-free")
                .value_name("GIB")
                .default_value("1")
                .value_parser(gib)
                .help("Take no scene while the disk of --work has less free (GiB)"),
        )
        .arg(flag("drain", "End when no scene is left"))
        .arg(
            number("store-every", "60", "Store a running scene's state after so many seconds")
                .value_parser(value_parser!(u32).range(1..)),
        )
        .arg(
            number("patience", "3600", "Restart a scene in which nothing has moved for so many seconds")
                .value_parser(value_parser!(u32).range(1..)),
        )
        .arg(args::json())
        .after_help(examples(
            "segwild worker --farm nats://queue:4222/night",
            "segwild worker --farm tls://queue/night --artefacts s3://scenes --needs gpu=h100,memory=64 --drain",
        ))
}

/// What a worker has, as far as it was given.
#[derive(Clone, Debug, Default, PartialEq)]
struct Capacity {
    cores: Option<u32>,
    memory_gib: Option<f64>,
    accelerators: Option<u32>,
    gpu: Option<String>,
}

/// Reads `cores=8,memory=64,accelerators=1,gpu=h100`.
fn needs(text: &str) -> Result<Capacity, String> {
    let mut all = Capacity::default();
    for part in text.split(',').map(str::trim).filter(|part| !part.is_empty()) {
        let wrong = || format!("`{part}`: expected cores=N, memory=GIB, accelerators=N or gpu=NAME");
        let (name, value) = part.split_once('=').ok_or_else(wrong)?;
        match name.trim() {
            "cores" => all.cores = Some(value.parse().ok().filter(|&n| n > 0).ok_or_else(wrong)?),
            "memory" => {
                let size = value.parse().ok().filter(|&gib: &f64| gib.is_finite() && gib > 0.0);
                all.memory_gib = Some(size.ok_or_else(wrong)?);
            }
            "accelerators" => all.accelerators = Some(value.parse().map_err(|_| wrong())?),
            "gpu" if !value.is_empty() => all.gpu = Some(value.to_owned()),
            _ => return Err(wrong()),
        }
    }
    Ok(all)
}

/// Reads a number of GiB, as bytes.
fn gib(text: &str) -> Result<u64, String> {
    let size = text.parse().ok().filter(|gib: &f64| gib.is_finite() && *gib >= 0.0);
    let size = size.ok_or_else(|| format!("`{text}`: expected a number of GiB"))?;
    Ok((size * (1u64 << 30) as f64) as u64)
}

/// Works.
pub fn worker(matches: &ArgMatches) -> Result<(), Failure> {
    have_files_to_open()?;
    let farm = reach(matches, "worker")?.expect("clap requires --farm");
    let stop =
        stop_on_presses("storing what the scenes have, and handing them back; once more to stop at once")?;
    let given = matches.get_one::<Capacity>("needs").cloned().unwrap_or_default();
    let usual = usual_budget();
    let budget = Needs {
        cores: given.cores.unwrap_or(usual.cores),
        memory_bytes: given.memory_gib.map_or(usual.memory_bytes, |gib| (gib * (1u64 << 30) as f64) as u64),
        // One that is named is there.
        accelerators: given.accelerators.unwrap_or(u32::from(given.gpu.is_some())),
    };
    let seconds = |name: &str| *matches.get_one::<u32>(name).expect("it has a default");
    let terms = WorkerTerms {
        engine: &*farm.engine,
        artefacts: farm.artefacts,
        folder: path_of(matches, "work").unwrap_or_else(|| Path::new("runs").join("worker")),
        budget,
        accelerator: given.gpu,
        patience_s: f64::from(seconds("patience")),
        store_every: Duration::from_secs(seconds("store-every").into()),
        least_free_bytes: *matches.get_one::<u64>("least-free").expect("it has a default"),
        drain: matches.get_flag("drain"),
        program: std::env::current_exe()?,
        classify: exit::class,
        stop,
    };
    print_note(&format!("working for {}", farm.engine.address()));
    let mut events = BatchOutput::new(matches.get_flag("json"));
    let stopped = work(terms, &mut |event| events.show(event))?;
    match stopped {
        // Of one that drains, 0 says that no scene is left.
        true if matches.get_flag("drain") => Err(Failure {
            message: "stopped before the farm was empty; other workers continue the scenes".into(),
            code: exit::INTERRUPTED,
        }),
        true => {
            print_note("stopped; other workers continue the scenes");
            Ok(())
        }
        false => {
            print_note("no scene is left");
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn needs_are_read_and_nonsense_is_named() {
        let read = needs("gpu=h100, memory=64,cores=8").unwrap();
        assert_eq!((read.cores, read.memory_gib, read.gpu.as_deref()), (Some(8), Some(64.0), Some("h100")));
        for text in ["cores=0", "memory=-1", "memory=inf", "disk=3", "gpu=", "cores"] {
            assert!(needs(text).unwrap_err().contains(text), "{text}");
        }
        assert_eq!((gib("0"), gib("1.5")), (Ok(0), Ok(3 << 29)));
        for text in ["-1", "inf", "NaN", "much"] {
            assert!(gib(text).unwrap_err().contains(text), "{text}");
        }
    }
}
