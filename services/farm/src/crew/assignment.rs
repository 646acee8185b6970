//! A leased scene on its way through a machine: fetched, run, stored.

use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use segwild_flow::shortage::is_shortage_of_processes;

use super::child::{Ended, SceneWorker};
use super::event::BatchEvent;
use super::files::SceneFiles;
use super::host::{HostFailure, SceneHost};
use crate::engine::ErrorClass;

/// Work on a thread of its own.
struct Errand<T>(JoinHandle<Result<T, HostFailure>>);

impl<T: Send + 'static> Errand<T> {
    fn start(work: impl FnOnce() -> Result<T, HostFailure> + Send + 'static) -> Result<Self, HostFailure> {
        let refused = |error: std::io::Error| HostFailure {
            class: if is_shortage_of_processes(&error) {
                ErrorClass::Shortage
            } else {
                ErrorClass::Retryable
            },
            words: format!("a thread cannot be started: {error}"),
        };
        std::thread::Builder::new().name("artefacts".into()).spawn(work).map(Self).map_err(refused)
    }

    fn is_finished(&self) -> bool {
        self.0.is_finished()
    }

    fn result(self) -> Result<T, HostFailure> {
        self.0.join().unwrap_or_else(|_| Err(HostFailure::passing("its thread panicked")))
    }
}

/// What an assignment has to report.
pub(super) enum Step {
    /// Nothing yet.
    Goes,
    /// The state was stored.
    Stored {
        /// As this artefact.
        artefact: String,
        /// How long that took, in seconds.
        seconds: f64,
    },
    /// Its process has ended as it should, and what it made could not be stored: that is tried once more.
    Unstored {
        /// Why.
        words: String,
    },
    /// It is over: how its process ended, and the artefact with what it left.
    Over,
}

/// A leased scene with its process.
pub(super) struct Assignment {
    pub worker: SceneWorker,
    host: Arc<dyn SceneHost>,
    fetching: Option<Errand<()>>,
    storing: Option<(Instant, Errand<Option<String>>)>,
    /// When the state was last stored, or the work began.
    stored_at: Instant,
    /// The last artefact.
    pub stored: Option<String>,
    /// How its process ended.
    pub ended: Option<Ended>,
    ended_at: Option<Instant>,
    /// Whether what it left was stored, or need not be.
    is_settled: bool,
    /// Whether what its process made is stored for the second time, because the first one failed.
    pub stores_again: bool,
    /// Whether its process ended as it should, and what it made could not be stored.
    pub is_unstored: bool,
}

impl Assignment {
    pub fn new(worker: SceneWorker, host: Arc<dyn SceneHost>) -> Self {
        let mut assignment = Self {
            worker,
            host,
            fetching: None,
            storing: None,
            stored_at: Instant::now(),
            stored: None,
            ended: None,
            ended_at: None,
            is_settled: false,
            stores_again: false,
            is_unstored: false,
        };
        if assignment.host.is_remote() {
            let (host, lease) = (assignment.host.clone(), assignment.worker.lease.clone());
            let scene = assignment.worker.scene.clone();
            match Errand::start(move || host.fetch(&lease, &scene)) {
                Ok(fetching) => assignment.fetching = Some(fetching),
                Err(failure) => assignment.give_up(failure),
            }
        }
        assignment
    }

    fn give_up(&mut self, failure: HostFailure) {
        self.ended = Some(Ended::NotStarted(failure.class, failure.words));
        self.is_settled = true;
    }

    /// Goes on as far as it can without waiting.
    pub fn advance(
        &mut self,
        files: &SceneFiles,
        program: &Path,
        store_every: Duration,
        tell: &mut dyn FnMut(&BatchEvent),
    ) -> Step {
        if self.is_settled && self.ended.is_some() {
            return Step::Over;
        }
        if let Some(fetching) = self.fetching.take() {
            if self.worker.stop_requested {
                // What was fetched so far is there the next time.
                (self.ended, self.is_settled) = (Some(Ended::Code(None)), true);
                return Step::Over;
            }
            if !fetching.is_finished() {
                self.fetching = Some(fetching);
                return Step::Goes;
            }
            if let Err(failure) = fetching.result() {
                self.give_up(failure);
                return Step::Over;
            }
            self.stored_at = Instant::now();
        }
        if self.ended.is_none() {
            self.ended = self.worker.advance(files, program, tell);
            self.ended_at = self.ended.is_some().then(Instant::now);
        }
        if let Some((began, storing)) = self.storing.take() {
            if !storing.is_finished() {
                self.storing = Some((began, storing));
                return Step::Goes;
            }
            return self.stored(began, storing.result());
        }
        if !self.host.is_remote() || !self.worker.has_started() {
            self.is_settled = self.ended.is_some();
        } else if self.ended.is_some() || self.stored_at.elapsed() >= store_every {
            let (host, scene) = (self.host.clone(), self.worker.scene.clone());
            match Errand::start(move || host.store(&scene)) {
                Ok(storing) => self.storing = Some((Instant::now(), storing)),
                Err(failure) => return self.stored(Instant::now(), Err(failure)),
            }
        }
        if self.is_settled && self.ended.is_some() { Step::Over } else { Step::Goes }
    }

    fn stored(&mut self, began: Instant, result: Result<Option<String>, HostFailure>) -> Step {
        self.stored_at = Instant::now();
        // Of what was stored while the process still ran, the end is missing.
        self.is_settled = self.ended.is_some() && self.ended_at.is_none_or(|ended| began >= ended);
        match result {
            Ok(artefact) => {
                if let Some(artefact) = artefact.filter(|artefact| self.stored.as_ref() != Some(artefact)) {
                    let seconds = began.elapsed().as_secs_f64();
                    self.stored = Some(artefact.clone());
                    return Step::Stored { artefact, seconds };
                }
                Step::Goes
            }
            Err(failure) => {
                if self.is_settled && matches!(self.ended, Some(Ended::Code(Some(0)))) {
                    if !std::mem::replace(&mut self.stores_again, true) {
                        self.is_settled = false;
                        return Step::Unstored { words: failure.words };
                    }
                    // A result that nobody finds is none.
                    self.is_unstored = true;
                    let words = format!("its result could not be stored: {failure}");
                    self.ended = Some(Ended::NotStarted(failure.class, words));
                } else {
                    tracing::warn!(scene = %self.worker.scene.name, %failure, "the state could not be stored");
                }
                Step::Goes
            }
        }
    }
}
