//! A farm of many machines: what its log costs on a real server, and how 10,000 scenes go through 200 simulated machines:
//! `segwild bench farm`.

mod error;
mod kills;
mod server;
mod simulation;

pub use self::error::FarmBenchError;
pub use self::kills::KillFigures;
pub use self::server::LogFigures;
pub use self::simulation::{SimulatedFarm, SimulatedFigures};

use self::kills::FarmSize;
use segwild_eval::record::Provenance;
use segwild_eval::stamp;
use std::path::PathBuf;

/// The farm whose parts are killed.
const KILLED_FARM: FarmSize = FarmSize { scenes: 12, workers: 4 };

/// How to measure.
#[derive(Clone, Debug)]
pub struct FarmBenchOptions {
    /// The server keeps its log here; what is there is removed.
    pub dir: PathBuf,
    /// The server program.
    pub server: PathBuf,
    /// The `segwild` program, for workers.
    pub program: PathBuf,
    /// How often something of a farm is killed; 0: that is not measured.
    pub kills: usize,
    /// Jobs of the log that is measured.
    pub jobs: usize,
    /// Simulated scenes.
    pub scenes: usize,
    /// Simulated machines.
    pub workers: usize,
    /// Seeds of the simulations: a farm each.
    pub seeds: Vec<u64>,
}

/// What was measured.
#[derive(Clone, Debug, PartialEq)]
pub struct FarmFigures {
    /// The log; `None` without a server program.
    pub log: Option<LogFigures>,
    /// A farm whose parts are killed; `None` where that was not measured.
    pub kills: Option<KillFigures>,
    /// The simulated farms.
    pub simulated: Vec<SimulatedFigures>,
}

/// Measures; `report` receives each simulated farm as soon as it is known.
///
/// # Errors
/// When the server refuses, or the machine.
pub fn farm(
    options: &FarmBenchOptions,
    mut report: impl FnMut(&SimulatedFigures),
) -> Result<FarmFigures, FarmBenchError> {
    let log = server::log(&options.server, &options.dir.join("log"), options.jobs)?;
    let kills = match options.kills {
        0 => None,
        count => {
            kills::kills(&options.program, &options.server, &options.dir.join("kills"), KILLED_FARM, count)?
        }
    };
    let mut simulated = Vec::new();
    for &seed in &options.seeds {
        let figures = SimulatedFarm { scenes: options.scenes, workers: options.workers, seed }.run();
        report(&figures);
        simulated.push(figures);
    }
    Ok(FarmFigures { log, kills, simulated })
}

/// The figures as a page.
pub fn page(figures: &FarmFigures, options: &FarmBenchOptions, made: &Provenance) -> String {
    let stamp = stamp::stamp(made, &["none: nothing is segmented"]);
    let mut text = format!(
        "# A farm, measured\n\nThis page is generated. {stamp}\n\n## The log on a real server\n\nA job is handed in, claimed and \
         completed: three changes. The server, the machines and this benchmark share the cores of one machine.\n\n"
    );
    match &figures.log {
        None => text += "Not measured: there is no nats-server here.\n",
        Some(log) => {
            text += &format!(
                "| what | measured |\n|---|---|\n| server | {} |\n| changes a second, one machine | {:.0} |\n| changes a second, \
                 four machines at once | {:.0} |\n| a machine joins and has read {} records after | {:.0} ms |\n| on the \
                 server's disk after {} records of {} jobs | {:.2} MiB |\n",
                log.server,
                log.changes_per_s,
                log.changes_per_s_of_four,
                log.join_records,
                log.join_ms,
                log.disk_records,
                log.jobs,
                log.disk_bytes as f64 / f64::from(1 << 20)
            );
        }
    }
    if let Some(k) = &figures.kills {
        let each: Vec<String> = k.killed.iter().map(|(what, n)| format!("{what} {n}")).collect();
        text += &format!(
            "\n## Killed at random moments\n\n{} small scenes, {} workers of one core, a server and a batch that watches, all on \
             one machine; each is killed (SIGKILL) at a random moment and starts again. One worker in twelve starts without its \
             folder, as on another machine: what it held is free when its lease ends, after 60 s and a rest.\n\n\
             | killed | machines lost | scenes that differ from one machine's in any byte | completed twice | taken in all | \
             farm took | one scene on one machine |\n|---|---:|---:|---:|---:|---:|---:|\n| {} | {} | {} | {} | {} | {:.0} s | \
             {:.1} s |\n",
            k.scenes,
            k.workers,
            each.join(", "),
            k.machines_lost,
            k.differing,
            k.completed_twice,
            k.taken,
            k.farm_s,
            k.alone_s
        );
    }
    text += &format!(
        "\n## {} scenes on {} simulated machines\n\nThe engine's own state machine decides; only the work is simulated. Machines \
         have 4, 8 or 16 cores, scenes take 1, 2 or 4 of them for half a core hour in the median (log-normal). 1 % of the scenes \
         have unusable photos, 3 % fail once, 0.2 % take their machine down whenever they are tried. Each machine falls silent \
         every 12 hours on average, for 5 minutes. The server is out of reach for 10 minutes. After half an hour come 20 urgent \
         scenes that need a machine of 16 cores for themselves.\n\n\
         | seed | done | dead (of hopeless) | lost | done twice | hours | over the ideal | cores busy while scenes wait | worked again | longest wait of an \
         urgent scene | tail over the longest scene | silent machines | records | records a second |\n\
         |---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n",
        options.scenes, options.workers
    );
    for s in &figures.simulated {
        text += &format!(
            "| {} | {} | {} ({}) | {} | {} | {:.2} | {:.3} | {:.1} % | {:.1} % | {:.0} min | {:.2} | {} | {} | {:.1} |\n",
            s.seed,
            s.done,
            s.dead,
            s.hopeless,
            s.lost,
            s.completed_twice,
            s.hours,
            s.over_ideal,
            100.0 * s.busy,
            100.0 * s.redone,
            s.urgent_wait_min,
            s.tail,
            s.silences,
            s.records,
            s.records_per_s
        );
    }
    text += "\nThe ideal is the work that was done divided by all cores (no machine idle, nothing worked twice), or the longest scene, where \
             that alone takes longer. Cores are counted as busy up to the moment when no scene waits any more.\n";
    text
}
