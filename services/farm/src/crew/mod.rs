//! The scenes that one machine works on: leased from an engine, each a process of its own, within the machine's budget.
//!
//! A scene's process keeps its standard input open and stops, resumable, when it ends: a crew that dies, however it dies,
//! leaves no process running.

mod assignment;
mod child;
mod disk;
mod event;
mod files;
mod host;
mod stop;

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

pub(crate) use disk::DiskGate;
pub use event::BatchEvent;
pub(crate) use files::SceneFiles;
pub(crate) use host::{HostFailure, LocalHost, SceneHost};
pub use stop::{StopBatch, StopLevel};

use self::assignment::{Assignment, Step};
use self::child::{Ended, SceneWorker};
use self::disk::DiskPause;
use crate::clock::{JobClock, SystemClock};
use crate::engine::{
    EngineError, ErrorClass, JobEngine, JobFate, JobLease, JobState, JobStatus, WorkerOffer,
};
use crate::job::Needs;
use crate::manifest::SceneJob;

/// A lease lasts so long without a heartbeat, in seconds.
pub const LEASE_S: f64 = 60.0;
/// How often processes are checked.
const TICK: Duration = Duration::from_millis(100);
/// A jump of the clock that is reported, in seconds.
const JUMP_REPORTED_S: f64 = 60.0;
/// How often work is requested when nothing has changed.
const ASK_EVERY: Duration = Duration::from_secs(1);
/// How often a worker that holds nothing tells its farm that it lives. One that holds scenes renews their leases.
pub const ANNOUNCE_EVERY: Duration = Duration::from_secs(60);

/// What a machine works with.
pub(crate) struct CrewTerms<'a> {
    /// Whose jobs.
    pub engine: &'a dyn JobEngine,
    /// Who it is for the engine.
    pub name: String,
    /// What may be used of the machine.
    pub budget: Needs,
    /// The accelerator that the machine has, as jobs name it.
    pub accelerator: Option<String>,
    /// A process in which nothing has moved for so long, in seconds, is ended.
    pub patience_s: f64,
    /// The state of a scene is stored so often, where scenes are stored.
    pub store_every: Duration,
    /// Whether it ends when no job is open.
    pub ends_when_idle: bool,
    /// The program whose `run` command runs a scene.
    pub program: PathBuf,
    /// What kind of failure an exit code is; `None`: ended by a signal.
    pub classify: fn(Option<i32>) -> ErrorClass,
    /// Who stops it.
    pub stop: StopBatch,
    /// Where settings and logs are.
    pub files: SceneFiles,
    /// Where scenes come from, and where their state goes.
    pub host: Arc<dyn SceneHost>,
    /// Whether the machine's disk has space for a further scene; without it, that is not decided here.
    pub disk: Option<DiskGate>,
    /// Where events go.
    pub tell: &'a mut dyn FnMut(&BatchEvent),
}

impl CrewTerms<'_> {
    /// Works until nothing is left, or until a stop is requested; returns whether it was interrupted. Whatever goes wrong, no
    /// process is left running.
    pub fn work(self) -> Result<bool, EngineError> {
        let mut crew = Crew {
            // What a process before this one could not delete any more.
            to_clear: self.host.is_remote(),
            terms: self,
            assignments: Vec::new(),
            silent: false,
            announced: None,
            pause: None,
            filled: false,
            reclaimed: false,
            clearing: None,
            unstored: Vec::new(),
        };
        let outcome = crew.conduct();
        crew.abandon();
        outcome
    }
}

struct Crew<'a> {
    terms: CrewTerms<'a>,
    assignments: Vec<Assignment>,
    /// Whether the engine did not answer the last time.
    silent: bool,
    /// When it last announced to its farm what it has.
    announced: Option<Instant>,
    /// Why this machine takes no scenes, as the engine has noted it.
    pause: Option<DiskPause>,
    /// A scene has filled the disk: how much is free after it is measured once what it left is deleted.
    filled: bool,
    /// Whether space was made since the disk was last found to be short of it.
    reclaimed: bool,
    /// Deletes what was put aside.
    clearing: Option<JoinHandle<()>>,
    /// Whether more was put aside meanwhile.
    to_clear: bool,
    /// Scenes that are done here and could not be stored: their folders stay as long as nobody else has them.
    unstored: Vec<SceneJob>,
}

impl Crew<'_> {
    fn conduct(&mut self) -> Result<bool, EngineError> {
        let (mut last_request, mut clocks_read): (Option<Instant>, Option<Instant>) = (None, None);
        loop {
            let stop = self.terms.stop.level();
            for assignment in &mut self.assignments {
                match stop {
                    StopLevel::Run => {}
                    StopLevel::Stop => assignment.worker.ask_to_stop(),
                    StopLevel::AtOnce => assignment.worker.kill(),
                }
            }
            for assignment in &mut self.assignments {
                assignment.worker.check_progress(self.terms.patience_s);
            }
            self.is_clearing();
            let changed = self.reap()?;
            self.beat()?;
            if clocks_read.is_none_or(|at| at.elapsed() >= ASK_EVERY) {
                clocks_read = Some(Instant::now());
                let jumps = self.terms.engine.jumps();
                for seconds in self.answered(jumps)?.unwrap_or_default() {
                    if seconds.abs() >= JUMP_REPORTED_S {
                        (self.terms.tell)(&BatchEvent::ClockJumped { seconds });
                    }
                }
            }
            if stop > StopLevel::Run {
                if self.assignments.is_empty() {
                    return Ok(self.open_jobs()? != Some(0));
                }
            } else if changed || last_request.is_none_or(|at| at.elapsed() >= ASK_EVERY) {
                self.announce()?;
                while self.claim()? {}
                last_request = Some(Instant::now());
                if self.terms.ends_when_idle && self.assignments.is_empty() && self.open_jobs()? == Some(0) {
                    return Ok(false);
                }
            }
            self.terms.stop.wait(TICK);
        }
    }

    /// An engine's answer; `None` where it does not answer now. The work goes on meanwhile.
    fn answered<T>(&mut self, answer: Result<T, EngineError>) -> Result<Option<T>, EngineError> {
        match answer {
            Err(EngineError::Server { reason, .. }) => {
                if !std::mem::replace(&mut self.silent, true) {
                    (self.terms.tell)(&BatchEvent::EngineSilent { reason: reason.to_string() });
                }
                Ok(None)
            }
            Err(error) => Err(error),
            Ok(answer) => {
                if std::mem::take(&mut self.silent) {
                    (self.terms.tell)(&BatchEvent::EngineBack);
                }
                Ok(Some(answer))
            }
        }
    }

    /// As [`Crew::answered`], of a call by who holds a lease; `Some(None)`: it is lost.
    fn answered_holder<T>(
        &mut self,
        answer: Result<T, EngineError>,
    ) -> Result<Option<Option<T>>, EngineError> {
        match answer {
            Err(EngineError::Lost { .. }) => Ok(Some(None)),
            other => Ok(self.answered(other)?.map(Some)),
        }
    }

    /// How many jobs are not ended yet.
    fn open_jobs(&mut self) -> Result<Option<usize>, EngineError> {
        let open = |j: &&JobStatus| matches!(j.state, JobState::Pending | JobState::Leased);
        let jobs = self.terms.engine.jobs();
        Ok(self.answered(jobs)?.map(|jobs| jobs.iter().filter(open).count()))
    }

    fn free(&self) -> Needs {
        self.assignments.iter().fold(self.terms.budget, |free, a| a.worker.granted.taken_from(&free))
    }

    /// So many of the machine's cores that no scene has: a scene's actors compute at the same time, each with as many
    /// threads as the scene has cores, and without a fence they would take the cores of others. None where the budget
    /// promises more cores than there are.
    fn cpus(&self, count: u32) -> Vec<u32> {
        let taken = |core: &u32| self.assignments.iter().any(|a| a.worker.cpus.contains(core));
        let free: Vec<u32> = segwild_flow::cpu::allowed().into_iter().filter(|core| !taken(core)).collect();
        free.get(..count as usize).map(<[u32]>::to_vec).unwrap_or_default()
    }

    /// What it has, and how much of that is free.
    fn offer(&self, free: Needs) -> WorkerOffer {
        WorkerOffer {
            worker: self.terms.name.clone(),
            free,
            whole: self.terms.budget,
            accelerator: self.terms.accelerator.clone(),
            lease_s: LEASE_S,
        }
    }

    /// Tells a farm what the machine has: at first, and again and again while it holds nothing.
    fn announce(&mut self) -> Result<(), EngineError> {
        let again = |at: Instant| self.assignments.is_empty() && at.elapsed() >= ANNOUNCE_EVERY;
        if !self.terms.host.is_remote() || !self.announced.is_none_or(again) {
            return Ok(());
        }
        let announced = self.terms.engine.announce(&self.offer(self.free()));
        if self.answered(announced)?.is_some() {
            self.announced = Some(Instant::now());
            // A farm may forget a worker, or be set up again.
            if let Some(pause) = self.pause.clone() {
                let noted = self.terms.engine.note_pause(&self.terms.name, Some(&pause.words));
                self.answered(noted)?;
            }
        }
        Ok(())
    }

    /// Takes a scene; `false` when none fits now.
    fn claim(&mut self) -> Result<bool, EngineError> {
        let free = self.free();
        if free.cores == 0 || self.is_short_of_space()? {
            return Ok(false);
        }
        let claimed = self.terms.engine.claim(&self.offer(free));
        let Some(lease) = self.answered(claimed)?.flatten() else { return Ok(false) };
        let scene = match self.terms.host.scene(&lease.job) {
            Ok(scene) => scene,
            Err(failure) => {
                self.failed(&lease, failure.class, &failure.words)?;
                return Ok(true);
            }
        };
        if let Err(error) = self.terms.files.write_settings(&scene) {
            let words = format!("its settings cannot be written: {error}");
            let full = self.is_refused_by_disk(&words);
            // A disk with no space for a few settings is no scene's doing.
            let class = if full { ErrorClass::Shortage } else { ErrorClass::Retryable };
            let words = self.named(full, words);
            self.failed(&lease, class, &words)?;
            self.count_disk(false, full);
            return Ok(true);
        }
        let mut granted = if lease.alone { free } else { lease.job.needs };
        // The last scene need not leave cores idle that nobody else needs.
        let jobs = self.terms.engine.jobs();
        let nobody_waits = |jobs: Vec<JobStatus>| !jobs.iter().any(|j| j.state == JobState::Pending);
        if self.answered(jobs)?.is_some_and(nobody_waits) {
            granted.cores = free.cores;
        }
        if self.terms.host.is_remote() {
            let resumes = lease.checkpoint.is_some();
            (self.terms.tell)(&BatchEvent::SceneFetches { scene: scene.name.clone(), resumes });
        }
        let cpus = self.cpus(granted.cores);
        let worker = SceneWorker::new(lease, scene, granted, cpus);
        self.assignments.push(Assignment::new(worker, self.terms.host.clone()));
        Ok(true)
    }

    /// Whether the disk has no space for a further scene. When that changes, the farm and who watches this machine learn why.
    fn is_short_of_space(&mut self) -> Result<bool, EngineError> {
        let is_clearing = self.is_clearing();
        let Some(disk) = &mut self.terms.disk else { return Ok(false) };
        if is_clearing {
            // How much is free shows once that is over.
            return Ok(self.filled || disk.closed().is_some());
        }
        if std::mem::take(&mut self.filled) {
            disk.fill();
        }
        let pause = disk.closed();
        self.reclaimed &= pause.is_some();
        if pause.is_some() && self.pause.is_none() && !std::mem::replace(&mut self.reclaimed, true) {
            // What scenes left that went elsewhere may be all that is too much.
            self.reclaim();
            if self.is_clearing() {
                return Ok(true);
            }
        }
        let is_noted = match (&pause, &self.pause) {
            (Some(now), Some(before)) => now.has_reason_of(before),
            (now, before) => now.is_some() == before.is_some(),
        };
        if !is_noted {
            let words = pause.as_ref().map(|pause| pause.words.as_str());
            let noted = self.terms.engine.note_pause(&self.terms.name, words);
            if self.answered(noted)?.is_some() {
                self.pause.clone_from(&pause);
                (self.terms.tell)(&match &pause {
                    Some(pause) => BatchEvent::WorkerPaused { reason: pause.words.clone() },
                    None => BatchEvent::WorkerResumed,
                });
            }
        }
        Ok(pause.is_some())
    }

    /// Removes what scenes left that this machine has not got now.
    fn reclaim(&mut self) {
        if !self.unstored.is_empty() {
            let jobs = self.terms.engine.jobs();
            // Of a scene that somebody else has taken, what is here is worth nothing.
            self.unstored.retain(|scene| {
                let waits = |job: &JobStatus| job.job.id == scene.name && job.state == JobState::Pending;
                jobs.as_ref().map_or(true, |jobs| jobs.iter().any(waits))
            });
        }
        let own = self.assignments.iter().map(|a| &a.worker.scene);
        let here: Vec<&SceneJob> = own.chain(&self.unstored).collect();
        self.to_clear |= self.terms.host.reclaim(&here);
    }

    /// Deletes what was put aside, on a thread of its own: a run folder may take seconds, and leases must be renewed.
    /// Returns whether it is still at that.
    fn is_clearing(&mut self) -> bool {
        if self.clearing.as_ref().is_some_and(|clearing| !clearing.is_finished()) {
            return true;
        }
        if let Some(ended) = self.clearing.take() {
            // One that panicked has left what it could not delete.
            let _ = ended.join();
        }
        if !std::mem::take(&mut self.to_clear) {
            return false;
        }
        let host = self.terms.host.clone();
        match std::thread::Builder::new().name("clearing".into()).spawn(move || host.clear()) {
            Ok(clearing) => self.clearing = Some(clearing),
            Err(_) => self.terms.host.clear(),
        }
        self.clearing.is_some()
    }

    /// Whether the disk is at fault for a failure, by its words.
    fn is_refused_by_disk(&self, words: &str) -> bool {
        self.terms.disk.as_ref().is_some_and(|disk| disk.refused(words))
    }

    /// Whether an assignment has ended because of the disk.
    fn ended_by_disk(&self, assignment: &Assignment) -> bool {
        let worker = &assignment.worker;
        match &assignment.ended {
            None | Some(Ended::Code(Some(0))) => false,
            Some(Ended::Code(_)) if worker.stop_requested => false,
            Some(Ended::Code(code)) => self.is_refused_by_disk(&worker.last_words(&self.terms.files, *code)),
            Some(Ended::NotStarted(_, words)) => self.is_refused_by_disk(words),
        }
    }

    /// The words of a failure; of one of the disk, with the machine that has it.
    fn named(&self, full: bool, words: String) -> String {
        match self.terms.disk.as_ref().filter(|_| full) {
            Some(disk) => disk.words(&self.terms.name, &words),
            None => words,
        }
    }

    /// Notes that a scene is done, or that the disk was full. A full one is freed as far as it can be.
    fn count_disk(&mut self, done: bool, full: bool) {
        if full {
            self.reclaim();
            (self.filled, self.reclaimed) = (true, true);
        } else if let Some(disk) = self.terms.disk.as_mut().filter(|_| done) {
            disk.done();
        }
    }

    /// Lets every assignment go on, and books those that are over; returns whether any is.
    fn reap(&mut self) -> Result<bool, EngineError> {
        let mut changed = false;
        let mut i = 0;
        // In the order in which they were claimed: the most urgent process is started first.
        while i < self.assignments.len() {
            if self.assignments[i].stores_again && self.is_clearing() {
                // It may have more space then.
                i += 1;
                continue;
            }
            let assignment = &mut self.assignments[i];
            let (waited, had_started) = (assignment.worker.waits.is_some(), assignment.worker.has_started());
            let step = assignment.advance(
                &self.terms.files,
                &self.terms.program,
                self.terms.store_every,
                self.terms.tell,
            );
            let worker = &assignment.worker;
            // The status of the batch shows which scenes wait, and why.
            let starts = waited && worker.has_started() && !had_started;
            if starts || !waited && worker.waits.is_some() {
                let (lease, reason) = (worker.lease.clone(), worker.waits.clone().filter(|_| !starts));
                let noted = self.terms.engine.note_wait(&lease, reason.as_deref());
                self.answered_holder(noted)?;
            }
            match step {
                Step::Goes => i += 1,
                Step::Stored { artefact, seconds } => {
                    let worker = &self.assignments[i].worker;
                    let (lease, scene) = (worker.lease.clone(), worker.scene.name.clone());
                    let noted = self.terms.engine.checkpoint(&lease, &artefact);
                    // Others find it from now on.
                    if self.answered_holder(noted)?.is_some_and(|held| held.is_some()) {
                        (self.terms.tell)(&BatchEvent::SceneStored { scene, seconds });
                    }
                    i += 1;
                }
                Step::Unstored { words } => {
                    let scene = &self.assignments[i].worker.scene.name;
                    tracing::warn!(%scene, %words, "the result could not be stored; that is tried once more");
                    if self.is_refused_by_disk(&words) {
                        self.reclaim();
                    }
                    i += 1;
                }
                Step::Over => {
                    let full = self.ended_by_disk(&self.assignments[i]);
                    if self.book(i, full)? {
                        let ended = self.assignments.remove(i);
                        let done = matches!(ended.ended, Some(Ended::Code(Some(0))));
                        // What is here of a scene that filled the disk goes: it continues from what is stored. One that is
                        // done and could not be stored stays: all that is left to do is to store it.
                        let (scene, stays) = (ended.worker.scene, ended.is_unstored || !done && !full);
                        self.to_clear |= self.terms.host.leave(&scene, stays);
                        self.unstored.retain(|other| other.out != scene.out);
                        self.unstored.extend(ended.is_unstored.then_some(scene));
                        self.count_disk(done, full);
                        changed = true;
                    } else {
                        i += 1;
                    }
                }
            }
        }
        Ok(changed)
    }

    /// Books how an assignment ended, because of a `full` disk or not; `false` where the engine does not answer now.
    fn book(&mut self, i: usize, full: bool) -> Result<bool, EngineError> {
        let assignment = &self.assignments[i];
        let worker = &assignment.worker;
        let (lease, scene) = (worker.lease.clone(), worker.scene.name.clone());
        match &assignment.ended {
            None => Ok(true),
            Some(Ended::Code(Some(0))) => {
                let seconds = worker.seconds();
                let mut outcome = serde_json::json!({ "seconds": seconds });
                if let Some(artefact) = &assignment.stored {
                    outcome["artefact"] = artefact.clone().into();
                }
                let completed = self.terms.engine.complete(&lease, &outcome.to_string());
                let Some(answer) = self.answered_holder(completed)? else { return Ok(false) };
                if answer.is_some() {
                    (self.terms.tell)(&BatchEvent::SceneDone { scene, seconds });
                }
                Ok(true)
            }
            Some(Ended::Code(_)) if worker.stop_requested => {
                let failed = self.terms.engine.fail(&lease, ErrorClass::Stopped, "stopped");
                let Some(answer) = self.answered_holder(failed)? else {
                    // A lease of who was stopped and cannot say so runs out.
                    return Ok(self.terms.stop.level() > StopLevel::Run);
                };
                if answer.is_some() {
                    (self.terms.tell)(&BatchEvent::SceneStopped { scene });
                }
                Ok(true)
            }
            Some(Ended::Code(code)) => {
                let error = self.named(full, worker.last_words(&self.terms.files, *code));
                let class = (self.terms.classify)(*code);
                self.failed(&lease, class, &error)
            }
            Some(Ended::NotStarted(class, error)) => {
                let (class, error) = (*class, self.named(full, error.clone()));
                self.failed(&lease, class, &error)
            }
        }
    }

    /// Ends an attempt; `false` where the engine does not answer now.
    fn failed(&mut self, lease: &JobLease, class: ErrorClass, error: &str) -> Result<bool, EngineError> {
        let (scene, error) = (lease.job.id.clone(), error.to_owned());
        let fate = self.terms.engine.fail(lease, class, &error);
        let Some(fate) = self.answered_holder(fate)? else { return Ok(false) };
        match fate {
            Some(JobFate::Retry { due }) => {
                // Between the two readings the clock may have jumped.
                let delay_s = (due - SystemClock.now()).clamp(0.0, lease.job.retry.longest_delay_s);
                (self.terms.tell)(&BatchEvent::SceneRetries { scene, error, delay_s });
            }
            Some(JobFate::Dead) => (self.terms.tell)(&BatchEvent::SceneDied { scene, error }),
            Some(JobFate::Released) => (self.terms.tell)(&BatchEvent::SceneStopped { scene }),
            None => {}
        }
        Ok(true)
    }

    /// Renews leases that are a third over.
    fn beat(&mut self) -> Result<(), EngineError> {
        for i in 0..self.assignments.len() {
            let worker = &mut self.assignments[i].worker;
            if worker.renewed.elapsed().as_secs_f64() < LEASE_S / 3.0 {
                continue;
            }
            worker.renewed = Instant::now();
            let lease = worker.lease.clone();
            let renewed = self.terms.engine.heartbeat(&lease);
            match self.answered_holder(renewed)? {
                Some(Some(until)) => self.assignments[i].worker.lease.until = until,
                // Somebody else has the scene: two must not work on it.
                Some(None) => self.assignments[i].worker.kill(),
                None => {}
            }
        }
        Ok(())
    }

    /// At the end, or after an error: stops who still runs, and is no worker any more that takes no scenes.
    fn abandon(&mut self) {
        for assignment in &mut self.assignments {
            assignment.worker.ask_to_stop();
        }
        for mut assignment in self.assignments.drain(..) {
            assignment.worker.wait();
        }
        if self.pause.take().is_some()
            && let Err(error) = self.terms.engine.note_pause(&self.terms.name, None)
        {
            tracing::warn!(%error, "the farm shows this worker as one that takes no scenes");
        }
        while self.is_clearing() {
            if let Some(clearing) = self.clearing.take() {
                let _ = clearing.join();
            }
        }
    }
}
