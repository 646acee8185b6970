//! What a farm's log costs on a real server.

use super::error::FarmBenchError;
use segwild_farm::{
    Decision, FarmAccess, FarmAddress, Job, JobEngine, JobTable, NatsEngine, Needs, Transition, WorkerOffer,
};
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// What a log on JetStream does on this machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogFigures {
    /// The server's version.
    pub server: String,
    /// Jobs that were handed in, claimed and completed.
    pub jobs: usize,
    /// Changes a second by one machine: handing in, claiming, completing.
    pub changes_per_s: f64,
    /// Changes a second of four machines that work at once, all together.
    pub changes_per_s_of_four: f64,
    /// How long folding a change into the table takes, in microseconds, on average over the log of these jobs.
    pub fold_us: f64,
    /// The log as it grows: after each quarter of the jobs.
    pub growth: Vec<LogGrowth>,
}

/// A log of some length.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogGrowth {
    /// Records that were ever appended.
    pub records: u64,
    /// Changes a second by one machine, of the last quarter.
    pub changes_per_s: f64,
    /// How long a machine that joins takes until it knows the jobs, in milliseconds.
    pub join_ms: f64,
    /// Records that it reads and folds for that; what is older it takes from a snapshot.
    pub join_records: u64,
    /// Bytes on the server's disk.
    pub disk_bytes: u64,
}

/// A server with its store in a folder; it ends with this value.
pub(super) struct NatsProcess {
    child: Child,
    host: String,
    port: u16,
}

impl Drop for NatsProcess {
    fn drop(&mut self) {
        self.kill();
    }
}

/// This machine, for itself alone.
pub(super) const LOCAL: &str = "127.0.0.1";
/// How long a server may take to start.
const START: Duration = Duration::from_secs(20);
/// A log is folded so often while that is timed.
const FOLDED: usize = 20;

impl NatsProcess {
    /// The address of a farm on it.
    pub fn address(&self, farm: &str) -> String {
        format!("nats://{}:{}/{farm}", self.host, self.port)
    }

    pub fn port(&self) -> u16 {
        self.port
    }

    /// Ends it at once.
    pub fn kill(&mut self) {
        // One that has ended by itself is as good.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Starts a server at an address of this machine, on a port or on any; `None` where there is no such program.
    pub fn start(
        program: &Path,
        folder: &Path,
        host: &str,
        port: Option<u16>,
    ) -> Result<Option<NatsProcess>, FarmBenchError> {
        start(program, folder, host, port)
    }
}

fn start(
    program: &Path,
    folder: &Path,
    host: &str,
    port: Option<u16>,
) -> Result<Option<NatsProcess>, FarmBenchError> {
    let port = port.map_or_else(|| "-1".to_owned(), |port| port.to_string());
    let io = |source| FarmBenchError::Io { path: folder.to_owned(), source };
    let ports = folder.join("ports");
    if ports.exists() {
        std::fs::remove_dir_all(&ports).map_err(io)?;
    }
    std::fs::create_dir_all(&ports).map_err(io)?;
    let spawned = Command::new(program)
        .args(["-a", host, "-p", &port, "-js", "-sd"])
        .arg(folder.join("store"))
        .arg("--ports_file_dir")
        .arg(&ports)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    let child = match spawned {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        other => other.map_err(io)?,
    };
    let mut process = NatsProcess { child, host: host.to_owned(), port: 0 };
    let began = Instant::now();
    while began.elapsed() < START {
        let file = std::fs::read_dir(&ports).map_err(io)?.find_map(|entry| Some(entry.ok()?.path()));
        let text = file.and_then(|file| std::fs::read_to_string(file).ok()).unwrap_or_default();
        let read: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
        if let Some(port) = read["nats"][0].as_str().and_then(|url| url.rsplit(':').next()?.parse().ok()) {
            process.port = port;
            return Ok(Some(process));
        }
        std::thread::park_timeout(Duration::from_millis(10));
    }
    Err(FarmBenchError::Server(program.to_owned()))
}

/// Measures a log; `None` where there is no server program.
pub(super) fn log(program: &Path, folder: &Path, jobs: usize) -> Result<Option<LogFigures>, FarmBenchError> {
    if folder.exists() {
        let removed = std::fs::remove_dir_all(folder);
        removed.map_err(|source| FarmBenchError::Io { path: folder.to_owned(), source })?;
    }
    let Some(server) = NatsProcess::start(program, folder, LOCAL, None)? else { return Ok(None) };
    let version = Command::new(program).arg("--version").output().ok();
    let version = version.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
    let connect = |farm: &str| -> Result<NatsEngine, FarmBenchError> {
        let address: FarmAddress = server.address(farm).parse()?;
        Ok(NatsEngine::connect(&address, &FarmAccess::default(), "bench", START)?)
    };
    let needs = Needs { cores: 1, memory_bytes: 1 << 30, accelerators: 0 };
    // As long as that of a scene.
    let payload = format!("{{\"photos\": \"{}\", \"settings\": {{\"steps\": \"2000\"}}}}", "a".repeat(64));
    let hand_in = |engine: &NatsEngine, jobs: Range<usize>| -> Result<(), FarmBenchError> {
        for i in jobs {
            engine.publish(&Job::new(format!("night/{i:05}"), &*payload, needs))?;
        }
        Ok(())
    };
    let work = |engine: &NatsEngine, name: &str| -> Result<usize, FarmBenchError> {
        let mut done = 0;
        while let Some(lease) = engine.claim(&WorkerOffer::all(name, needs, 60.0))? {
            engine.complete(&lease, "{\"seconds\": 100}")?;
            done += 1;
        }
        Ok(done)
    };
    let engine = connect("alone")?;
    let (mut growth, mut seconds) = (Vec::new(), 0.0);
    // Of fewer jobs than quarters, some quarters have none.
    for quarter in (0..4).map(|q| q * jobs / 4..(q + 1) * jobs / 4).filter(|quarter| !quarter.is_empty()) {
        let began = Instant::now();
        let changes = 3.0 * quarter.len() as f64;
        hand_in(&engine, quarter)?;
        work(&engine, "alone")?;
        let took = began.elapsed().as_secs_f64();
        seconds += took;
        let began = Instant::now();
        let joined = connect("alone")?;
        growth.push(LogGrowth {
            records: joined.records(),
            changes_per_s: changes / took,
            join_ms: began.elapsed().as_secs_f64() * 1e3,
            join_records: joined.log_state().unwrap_or_default().read_records,
            disk_bytes: size(&folder.join("store")),
        });
    }
    let changes_per_s = 3.0 * jobs as f64 / seconds;
    let engine = connect("four")?;
    hand_in(&engine, 0..jobs)?;
    let began = Instant::now();
    let done: Result<Vec<usize>, FarmBenchError> = std::thread::scope(|scope| {
        let work = &work;
        let connect = &connect;
        let workers: Vec<_> =
            (0..4).map(|w| scope.spawn(move || work(&connect("four")?, &format!("w{w}")))).collect();
        workers.into_iter().map(|w| w.join().unwrap_or(Err(FarmBenchError::Panicked))).collect()
    });
    let changes_per_s_of_four = 2.0 * done?.into_iter().sum::<usize>() as f64 / began.elapsed().as_secs_f64();
    let server = version.unwrap_or_else(|| "unknown".into());
    let fold_us = fold_us(jobs, &payload, needs);
    Ok(Some(LogFigures { server, jobs, changes_per_s, changes_per_s_of_four, fold_us, growth }))
}

/// How long folding a change of so many jobs into a table takes, in microseconds: without the server, as everybody who reads the
/// log does it.
fn fold_us(jobs: usize, payload: &str, needs: Needs) -> f64 {
    let mut table = JobTable::default();
    let mut log = Vec::<Transition>::new();
    let mut append = |table: &mut JobTable, transitions: Vec<Transition>| {
        for transition in transitions {
            table.apply(&transition, 0.0, log.len() as u64 + 1);
            log.push(transition);
        }
    };
    for i in 0..jobs {
        let decision = table.publish(&Job::new(format!("night/{i:05}"), payload, needs));
        append(&mut table, decision.transitions);
    }
    let offer = WorkerOffer::all("fold", needs, 60.0);
    let completed = |job: &str| Transition::Completed { job: job.to_owned(), outcome: "{}".into() };
    loop {
        let Decision { transitions, answer } = table.claim(&offer, 0.0);
        append(&mut table, transitions);
        let Ok(Some(job)) = answer else { break };
        append(&mut table, vec![completed(&job)]);
    }
    let began = Instant::now();
    for _ in 0..FOLDED {
        let mut table = JobTable::default();
        for (i, transition) in log.iter().enumerate() {
            table.apply(transition, 0.0, i as u64 + 1);
        }
    }
    began.elapsed().as_secs_f64() * 1e6 / (FOLDED * log.len()).max(1) as f64
}

fn size(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let of = |path: PathBuf| match path.is_dir() {
        true => size(&path),
        false => path.metadata().map_or(0, |data| data.len()),
    };
    entries.map(|entry| of(entry.path())).sum()
}
