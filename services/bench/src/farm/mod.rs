//! A farm of many machines: what its log costs on a real server, what kills and cuts of the network do to a small farm, and how
//! 10,000 scenes go through 200 simulated machines: `segwild bench farm`.

mod cuts;
mod error;
mod kills;
mod network;
mod recovery;
mod server;
mod simulation;
mod small;

pub use self::error::FarmBenchError;
pub use self::network::CutNetwork;
pub use self::server::{LogFigures, LogGrowth};
pub use self::simulation::{SimulatedFarm, SimulatedFigures};
pub use self::small::FailureFigures;

use self::small::FarmSize;
use segwild_eval::record::Provenance;
use segwild_eval::stamp;
use std::path::PathBuf;

/// The farm whose parts are killed or cut off.
const FAILING_FARM: FarmSize = FarmSize { scenes: 12, workers: 4 };

/// The row of the cuts where they were not measured.
const NO_CUTS: &str = "| cut: not measured: that takes root, and `ip` (`apt-get install iproute2`) \
                       | | | | | | | | | |\n";

/// How to measure.
#[derive(Clone, Debug)]
pub struct FarmBenchOptions {
    /// The server keeps its log here; what is there is removed.
    pub dir: PathBuf,
    /// The server program.
    pub server: PathBuf,
    /// The `segwild` program, for workers.
    pub program: PathBuf,
    /// How often something of a farm is killed; 0: neither that nor a cut is measured.
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
    pub kills: Option<FailureFigures>,
    /// A farm whose workers are cut off; `None` where that was not measured.
    pub cuts: Option<FailureFigures>,
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
    let (mut kills, mut cuts) = (None, None);
    if options.kills > 0 {
        let (program, server) = (&options.program, &options.server);
        let dir = |name: &str| options.dir.join(name);
        kills = kills::kills(program, server, &dir("kills"), FAILING_FARM, options.kills)?;
        cuts = cuts::cuts(program, server, &dir("cuts"), FAILING_FARM)?;
    }
    let mut simulated = Vec::new();
    for &seed in &options.seeds {
        let figures = SimulatedFarm { scenes: options.scenes, workers: options.workers, seed }.run();
        report(&figures);
        simulated.push(figures);
    }
    Ok(FarmFigures { log, kills, cuts, simulated })
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
        Some(log) => text += &log_section(log),
    }
    if let Some(kills) = &figures.kills {
        text += &failures_section(kills, figures.cuts.as_ref());
    }
    text += &format!(
        "\n## {} scenes on {} simulated machines\n\nThe engine's own state machine decides; only the work is simulated. Machines \
         have 4, 8 or 16 cores, scenes take 1, 2 or 4 of them for half a core hour in the median (log-normal). 1 % of the scenes \
         have unusable photos, 3 % fail once, 0.2 % take their machine down whenever they are tried. Each machine falls silent \
         every 12 hours on average, for 5 minutes. The server is out of reach for 10 minutes. After half an hour come 20 urgent \
         scenes that need a machine of 16 cores for themselves.\n\n\
         | seed | done | dead (of hopeless) | lost | done twice | hours until all were done | over the ideal | scenes an hour (ideal) \
         | cores busy while scenes wait | worked again | longest wait of an urgent scene | overtaken by at most | tail over the \
         longest scene | silent machines | records | records a second |\n\
         |---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n",
        options.scenes, options.workers
    );
    for s in &figures.simulated {
        text += &format!(
            "| {} | {} | {} ({}) | {} | {} | {:.2} | {:.3} | {:.0} ({:.0}) | {:.1} % | {:.1} % | {:.0} min | {} | {:.2} | {} | {} \
             | {:.1} |\n",
            s.seed,
            s.done,
            s.dead,
            s.hopeless,
            s.lost,
            s.completed_twice,
            s.hours,
            s.over_ideal,
            s.done as f64 / s.hours,
            s.done as f64 / s.hours * s.over_ideal,
            100.0 * s.busy,
            100.0 * s.redone,
            s.urgent_wait_min,
            s.overtaken,
            s.tail,
            s.silences,
            s.records,
            s.records_per_s
        );
    }
    text += "\nThe ideal is the work that was done divided by all cores (no machine idle, nothing worked twice), or the longest scene, \
             where that alone takes longer. Cores are counted as busy up to the moment when no scene waits any more. Two columns show \
             starvation: how long an urgent scene that needs a whole machine waits, and by how many scenes that were behind it in the \
             queue any other scene was overtaken; smaller ones may pass one that fits nowhere.\n";
    text
}

/// The log's table, and how it grows.
fn log_section(log: &LogFigures) -> String {
    let mut text = format!(
        "| what | measured |\n|---|---|\n| server | {} |\n| changes a second, one machine | {:.0} |\n| changes a second, four \
         machines at once | {:.0} |\n| folding one of {} changes into the table, without the server | {:.1} µs |\n\n\
         As the log grows, a quarter of {} jobs after the other. A machine that joins takes the table from a snapshot, which the log \
         is compacted to every 1,024 records, and folds what follows.\n\n\
         | records | changes a second, one machine | a machine has joined after | records that it folds | on the server's disk |\n\
         |---:|---:|---:|---:|---:|\n",
        log.server,
        log.changes_per_s,
        log.changes_per_s_of_four,
        3 * log.jobs,
        log.fold_us,
        log.jobs
    );
    for LogGrowth { records, changes_per_s, join_ms, join_records, disk_bytes } in &log.growth {
        let mib = *disk_bytes as f64 / f64::from(1 << 20);
        text += &format!(
            "| {records} | {changes_per_s:.0} | {join_ms:.0} ms | {join_records} | {mib:.2} MiB |\n"
        );
    }
    text
}

/// What kills and cuts did to a farm; without figures of cuts, the row says why.
fn failures_section(kills: &FailureFigures, cuts: Option<&FailureFigures>) -> String {
    let mut text = format!(
        "\n## Killed and cut off at random moments\n\n{} small scenes, {} workers of one core, a server and a batch that watches, all \
         on one machine. Killed: each is killed (SIGKILL) at a random moment and starts again. One worker in twelve starts without its \
         folder, as on another machine: what it held is free when its lease ends, after 60 s and a rest. Cut off: all workers but one \
         are in a network of their own (a namespace), whose link goes down while they have scenes and compute on: three times for 1 \
         to 5 s, and once for longer than a lease lasts. A scene is interrupted where its worker lost it; it recovers when a worker \
         takes it again.\n\n\
         | failures | machines lost | scenes lost | scenes that differ from one machine's in any byte | completed twice | taken in all | \
         interrupted | recovered after: median, longest | farm took | one scene on one machine |\n\
         |---|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n",
        kills.scenes, kills.workers
    );
    text += &failures_row("killed", kills);
    text += &cuts.map_or_else(|| NO_CUTS.to_owned(), |cuts| failures_row("cut", cuts));
    text
}

fn failures_row(what: &str, of: &FailureFigures) -> String {
    let each: Vec<String> = of.failures.iter().map(|(part, times)| format!("{part} {times}")).collect();
    let in_words = |(median, longest): (f64, f64)| format!("{median:.1} s, {longest:.1} s");
    let recovered = of.recovery_s().map_or_else(|| "–".to_owned(), in_words);
    format!(
        "| {what}: {} | {} | {} | {} | {} | {} | {} | {recovered} | {:.0} s | {:.1} s |\n",
        each.join(", "),
        of.machines_lost,
        of.lost,
        of.differing,
        of.completed_twice,
        of.taken,
        of.recoveries_s.len(),
        of.farm_s,
        of.alone_s
    )
}
