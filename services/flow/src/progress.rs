//! How a stage advances: rate and time left.

use std::time::{Duration, Instant};

use crate::cpu;
use crate::events::{Event, Events};

/// Progress is reported at most this often.
const EVERY: Duration = Duration::from_millis(100);
/// The rate forgets in about this time, in seconds.
const MEMORY: f64 = 10.0;

/// Tells of a stage's progress. Dropped without [`finish`](Self::finish) it tells nothing more: an interrupted
/// stage is not a finished one.
///
/// ```
/// let events = segwild_flow::Events::new();
/// let mut stage = events.stage("embed", Some(40));
/// stage.cached(30); // found in the cache: done, but no measure of the rate
/// for _ in 0..9 { stage.advance(1); }
/// stage.failed(1);
/// assert_eq!(stage.done(), 40);
/// stage.finish();
/// ```
pub struct StageProgress {
    events: Events,
    stage: String,
    part: Option<String>,
    total: Option<u64>,
    /// Of the stage's own work.
    own_total: Option<u64>,
    made: u64,
    cached: u64,
    failed: u64,
    began: Instant,
    cpu: Option<f64>,
    reported: Instant,
    /// Weighted counts of work and of time, both forgetting: their quotient is the rate.
    work: f64,
    time: f64,
    marked: Instant,
}

impl Events {
    /// Starts to report the progress of a stage: rate and time left are computed from how it advances.
    pub fn stage(&self, stage: &str, total: Option<u64>) -> StageProgress {
        StageProgress::start(self.clone(), stage, total)
    }
}

impl StageProgress {
    pub(crate) fn start(events: Events, stage: &str, total: Option<u64>) -> Self {
        events.tell(Event::StageStarted { stage: stage.into(), total });
        let now = Instant::now();
        Self {
            events,
            stage: stage.into(),
            part: None,
            total,
            own_total: total,
            made: 0,
            cached: 0,
            failed: 0,
            began: now,
            cpu: cpu::process_seconds(),
            reported: now,
            work: 0.0,
            time: 0.0,
            marked: now,
        }
    }

    /// Corrects how many units of work there are.
    pub fn set_total(&mut self, total: u64) {
        self.total = Some(total);
    }

    /// Starts the next part of a stage whose parts have units of their own: counts and rate start again, its times go on.
    ///
    /// ```
    /// let mut stage = segwild_flow::Events::new().stage("poses", Some(12));
    /// stage.advance(12);
    /// stage.next_part("matches", Some(66));
    /// assert_eq!((stage.part(), stage.done(), stage.rate()), (Some("matches"), 0, 0.0));
    /// stage.own_work();
    /// assert_eq!((stage.part(), stage.done()), (None, 0));
    /// ```
    pub fn next_part(&mut self, part: &str, total: Option<u64>) {
        self.restart(Some(part.to_owned()), total);
    }

    /// Starts the work that the stage was started with, after the parts that prepare it.
    pub fn own_work(&mut self) {
        self.restart(None, self.own_total);
    }

    fn restart(&mut self, part: Option<String>, total: Option<u64>) {
        self.part = part;
        (self.made, self.cached, self.failed) = (0, 0, 0);
        (self.work, self.time, self.marked) = (0.0, 0.0, Instant::now());
        self.total = total;
        self.report(self.marked);
    }

    /// The part that is under way, where the stage has parts with units of their own.
    pub fn part(&self) -> Option<&str> {
        self.part.as_deref()
    }

    /// So many units were done.
    pub fn advance(&mut self, units: u64) {
        self.made += units;
        self.measure(units);
    }

    /// So many units were in the cache.
    pub fn cached(&mut self, units: u64) {
        self.cached += units;
        self.measure(0);
    }

    /// So many units failed for good.
    pub fn failed(&mut self, units: u64) {
        self.failed += units;
        self.measure(units);
    }

    /// Units done, found and failed.
    pub fn done(&self) -> u64 {
        self.made + self.cached + self.failed
    }

    /// Units per second, lately; what was found in the cache does not count.
    pub fn rate(&self) -> f64 {
        if self.time > 0.0 { self.work / self.time } else { 0.0 }
    }

    /// Seconds to go, once a rate and a total are known.
    pub fn eta(&self) -> Option<f64> {
        let left = self.total?.saturating_sub(self.done()) as f64;
        (self.rate() > 0.0).then(|| left / self.rate())
    }

    /// Tells that the stage is done, and its times.
    pub fn finish(self) {
        let cpu_s = self.cpu.and_then(|before| Some(cpu::process_seconds()? - before));
        self.events.tell(Event::StageFinished {
            done: self.done(),
            failed: self.failed,
            cached: self.cached,
            wall_s: self.began.elapsed().as_secs_f64(),
            cpu_s,
            stage: self.stage,
        });
    }

    fn measure(&mut self, units: u64) {
        let now = Instant::now();
        let passed = (now - self.marked).as_secs_f64();
        self.marked = now;
        let keep = (-passed / MEMORY).exp();
        self.work = self.work * keep + units as f64;
        self.time = self.time * keep + passed;
        if now - self.reported >= EVERY || self.total == Some(self.done()) {
            self.report(now);
        }
    }

    fn report(&mut self, now: Instant) {
        self.reported = now;
        self.events.tell(Event::StageProgress {
            stage: self.stage.clone(),
            part: self.part.clone(),
            done: self.done(),
            total: self.total,
            rate: self.rate(),
            eta_s: self.eta(),
        });
    }
}
