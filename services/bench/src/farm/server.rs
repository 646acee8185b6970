//! What a farm's log costs on a real server.

use super::error::FarmBenchError;
use segwild_farm::{FarmAccess, FarmAddress, Job, JobEngine, NatsEngine, Needs, WorkerOffer};
use serde::{Deserialize, Serialize};
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
    /// How long a machine that joins reads the log, in milliseconds.
    pub join_ms: f64,
    /// Records that it reads.
    pub join_records: u64,
    /// Bytes on the server's disk.
    pub disk_bytes: u64,
    /// Records that were ever appended.
    pub disk_records: u64,
}

/// A server with its store in a folder; it ends with this value.
pub(super) struct NatsProcess {
    child: Child,
    port: u16,
}

impl Drop for NatsProcess {
    fn drop(&mut self) {
        self.kill();
    }
}

/// How long a server may take to start.
const START: Duration = Duration::from_secs(20);

impl NatsProcess {
    /// The address of a farm on it.
    pub fn address(&self, farm: &str) -> String {
        format!("nats://127.0.0.1:{}/{farm}", self.port)
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

    /// Starts a server on a port, or on any; `None` where there is no such program.
    pub fn start(
        program: &Path,
        folder: &Path,
        port: Option<u16>,
    ) -> Result<Option<NatsProcess>, FarmBenchError> {
        start(program, folder, port)
    }
}

fn start(program: &Path, folder: &Path, port: Option<u16>) -> Result<Option<NatsProcess>, FarmBenchError> {
    let port = port.map_or_else(|| "-1".to_owned(), |port| port.to_string());
    let io = |source| FarmBenchError::Io { path: folder.to_owned(), source };
    let ports = folder.join("ports");
    if ports.exists() {
        std::fs::remove_dir_all(&ports).map_err(io)?;
    }
    std::fs::create_dir_all(&ports).map_err(io)?;
    let spawned = Command::new(program)
        .args(["-a", "127.0.0.1", "-p", &port, "-js", "-sd"])
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
    let mut process = NatsProcess { child, port: 0 };
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
    let Some(server) = NatsProcess::start(program, folder, None)? else { return Ok(None) };
    let version = Command::new(program).arg("--version").output().ok();
    let version = version.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
    let connect = |farm: &str| -> Result<NatsEngine, FarmBenchError> {
        let address: FarmAddress = server.address(farm).parse()?;
        Ok(NatsEngine::connect(&address, &FarmAccess::default(), "bench", START)?)
    };
    let needs = Needs { cores: 1, memory_bytes: 1 << 30, accelerators: 0 };
    // As long as that of a scene.
    let payload = format!("{{\"photos\": \"{}\", \"settings\": {{\"steps\": \"2000\"}}}}", "a".repeat(64));
    let hand_in = |engine: &NatsEngine| -> Result<(), FarmBenchError> {
        for i in 0..jobs {
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
    let began = Instant::now();
    hand_in(&engine)?;
    work(&engine, "alone")?;
    let changes_per_s = 3.0 * jobs as f64 / began.elapsed().as_secs_f64();
    let began = Instant::now();
    let joined = connect("alone")?;
    let (join_ms, join_records) = (began.elapsed().as_secs_f64() * 1e3, joined.records());
    let (disk_bytes, disk_records) = (size(&folder.join("store")), engine.records());
    let engine = connect("four")?;
    hand_in(&engine)?;
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
    Ok(Some(LogFigures {
        server,
        jobs,
        changes_per_s,
        changes_per_s_of_four,
        join_ms,
        join_records,
        disk_bytes,
        disk_records,
    }))
}

fn size(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let of = |path: PathBuf| match path.is_dir() {
        true => size(&path),
        false => path.metadata().map_or(0, |data| data.len()),
    };
    entries.map(|entry| of(entry.path())).sum()
}
