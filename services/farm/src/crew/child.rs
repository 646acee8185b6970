//! One scene's process: started when its run folder is free, stopped by the end of its standard input.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::time::{Duration, Instant};

use segwild_flow::Ledger;
use segwild_flow::shortage::is_shortage_of_processes;

use super::event::BatchEvent;
use super::files::SceneFiles;
use crate::engine::{ErrorClass, JobLease};
use crate::job::Needs;
use crate::manifest::SceneJob;

/// An orphan of a killed batch may take so long to stop before the attempt counts as failed.
const FOLDER_WAIT: Duration = Duration::from_secs(60);

/// How a scene's process ended.
pub(super) enum Ended {
    /// With this exit code; `None`: by a signal.
    Code(Option<i32>),
    /// It could not be started: the class of the error, and its text.
    NotStarted(ErrorClass, String),
}

/// What kind of failure it is that the system refuses a process or a file.
fn class(error: &std::io::Error) -> ErrorClass {
    if is_shortage_of_processes(error) { ErrorClass::Shortage } else { ErrorClass::Retryable }
}

/// A leased scene and its process.
pub(super) struct SceneWorker {
    pub lease: JobLease,
    pub granted: Needs,
    /// The machine's cores that it runs on; none: on any.
    pub cpus: Vec<u32>,
    pub stop_requested: bool,
    /// When the lease was last renewed.
    pub renewed: Instant,
    /// Why it was ended, if it was for want of progress.
    pub hung: Option<String>,
    /// Why it could not be started when it was taken.
    pub waits: Option<String>,
    still: Still,
    pub scene: SceneJob,
    process: Option<Process>,
    taken: Instant,
}

/// For how long nothing has moved in a process, by this process's own clock.
struct Still {
    looked: Instant,
    /// How far its work was then.
    seen: Option<(u64, u64)>,
    seconds: f64,
}

struct Process {
    child: Child,
    /// The process runs while this is open.
    stdin: Option<ChildStdin>,
    began: Instant,
    /// Where in the log its words start.
    log_from: u64,
}

impl SceneWorker {
    pub fn new(lease: JobLease, scene: SceneJob, granted: Needs, cpus: Vec<u32>) -> Self {
        let taken = Instant::now();
        let still = Still { looked: taken, seen: None, seconds: 0.0 };
        let (stop_requested, hung, process, renewed) = (false, None, None, taken);
        Self {
            lease,
            granted,
            cpus,
            stop_requested,
            renewed,
            hung,
            waits: None,
            still,
            scene,
            process,
            taken,
        }
    }

    /// Whether its process was started.
    pub fn has_started(&self) -> bool {
        self.process.is_some()
    }

    pub fn seconds(&self) -> f64 {
        self.process.as_ref().map_or(0.0, |p| p.began.elapsed().as_secs_f64())
    }

    /// Starts the process if it can start; returns how it ended if it has.
    pub fn advance(
        &mut self,
        files: &SceneFiles,
        program: &Path,
        tell: &mut dyn FnMut(&BatchEvent),
    ) -> Option<Ended> {
        if let Some(process) = &mut self.process {
            return match process.child.try_wait() {
                Ok(None) => None,
                Ok(Some(status)) => Some(Ended::Code(status.code())),
                Err(error) => Some(Ended::NotStarted(class(&error), format!("its process is lost: {error}"))),
            };
        }
        if self.stop_requested {
            return Some(Ended::Code(None));
        }
        // A ledger that cannot be opened is the run's to report.
        let ledger = Ledger::open_read_only(self.scene.out.join("run.sqlite")).ok();
        if let Some(owner) = ledger.and_then(|ledger| ledger.owner()) {
            let reason = format!("its run folder is in use by {owner}");
            if self.taken.elapsed() > FOLDER_WAIT {
                return Some(Ended::NotStarted(ErrorClass::Retryable, reason));
            }
            if self.waits.is_none() {
                self.waits = Some(reason.clone());
                tell(&BatchEvent::SceneWaits { scene: self.scene.name.clone(), reason });
            }
            return None;
        }
        match self.start(files, program) {
            Ok(process) => {
                tell(&BatchEvent::SceneStarted {
                    scene: self.scene.name.clone(),
                    pid: process.child.id(),
                    attempt: self.lease.failures + 1,
                    cores: self.granted.cores,
                });
                self.process = Some(process);
                self.still = Still { looked: Instant::now(), seen: None, seconds: 0.0 };
                None
            }
            Err(error) => {
                Some(Ended::NotStarted(class(&error), format!("its process cannot be started: {error}")))
            }
        }
    }

    /// Its cores as the list that `--cpus` takes; `None`: any.
    fn cpu_list(&self) -> Option<String> {
        let list: Vec<String> = self.cpus.iter().map(u32::to_string).collect();
        (!list.is_empty()).then(|| list.join(","))
    }

    fn start(&self, files: &SceneFiles, program: &Path) -> std::io::Result<Process> {
        let mut log = files.open_log(&self.scene.name)?;
        writeln!(log, "== attempt {} on {} cores", self.lease.failures + 1, self.granted.cores)?;
        let log_from = log.metadata()?.len();
        let mut command = Command::new(program);
        command
            .arg("run")
            .arg(&self.scene.path)
            .arg("--out")
            .arg(&self.scene.out)
            .arg("--config")
            .arg(files.settings_file(&self.scene.name))
            .arg("--threads")
            .arg(self.granted.cores.to_string())
            .arg("--memory-budget")
            // 0 would be no limit at all.
            .arg((self.granted.memory_bytes >> 20).max(1).to_string())
            .arg("--stop-with-parent")
            .args(self.cpu_list().iter().flat_map(|list| ["--cpus", list]))
            .args(self.scene.until.iter().flat_map(|until| ["--until", until]))
            .stdin(Stdio::piped())
            .stdout(log.try_clone()?)
            .stderr(log);
        // Ctrl-C in the terminal is for the batch, which asks its scenes to stop.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.spawn()?;
        Ok(Process { stdin: child.stdin.take(), child, began: Instant::now(), log_from })
    }

    /// Asks the process to stop where it can go on.
    pub fn ask_to_stop(&mut self) {
        self.stop_requested = true;
        if let Some(process) = &mut self.process {
            process.stdin = None;
        }
    }

    /// Ends the process at once; what it has committed stays.
    pub fn kill(&mut self) {
        self.stop_requested = true;
        if let Some(process) = &mut self.process {
            // One that has ended by itself is as good.
            let _ = process.child.kill();
        }
    }

    /// Ends the process if nothing has moved in it for too long: if what it writes into its run's ledger has stayed the
    /// same over the time that was seen to pass here. Whatever the wall clock does meanwhile, and however long the
    /// machine sleeps or this process is held, no more passes than lies between two checks.
    pub fn check_progress(&mut self, patience_s: f64) {
        let Some(process) = &mut self.process else { return };
        let every = Duration::from_secs_f64((patience_s / 4.0).clamp(0.1, 10.0));
        let passed = self.still.looked.elapsed();
        if passed < every || self.hung.is_some() {
            return;
        }
        self.still.looked = Instant::now();
        let ledger = Ledger::open_read_only(self.scene.out.join("run.sqlite")).ok();
        let live = ledger.and_then(|ledger| ledger.live().ok().flatten());
        let seen = live.filter(|live| live.pid == process.child.id()).map(|live| live.movement());
        if seen == self.still.seen {
            self.still.seconds += passed.min(2 * every).as_secs_f64();
        } else {
            (self.still.seen, self.still.seconds) = (seen, 0.0);
        }
        if self.still.seconds > patience_s {
            self.hung = Some(format!("nothing moved for {:.0} s", self.still.seconds));
            // One that has ended by itself is as good.
            let _ = process.child.kill();
        }
    }

    /// Waits for the process to end.
    pub fn wait(&mut self) {
        if let Some(process) = &mut self.process {
            let _ = process.child.wait();
        }
    }

    /// Why it failed: its last words, or how it ended.
    pub fn last_words(&self, files: &SceneFiles, code: Option<i32>) -> String {
        if let Some(reason) = &self.hung {
            return reason.clone();
        }
        let from = self.process.as_ref().map_or(0, |p| p.log_from);
        let output = read_from(&files.log(&self.scene.name), from).unwrap_or_default();
        let error = output.lines().rev().find_map(|line| line.strip_prefix("error: ")).map(str::to_owned);
        match (error, code) {
            (Some(error), _) => error,
            (None, Some(code)) => {
                let last = output.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("no word");
                format!("exit code {code}: {}", last.trim())
            }
            (None, None) => "its process was killed (out of memory?)".into(),
        }
    }
}

/// The text of a log from a position on; of a long one, the end.
fn read_from(path: &Path, from: u64) -> std::io::Result<String> {
    const MOST: u64 = 64 << 10;
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(from.max(length.saturating_sub(MOST))))?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes)?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}
