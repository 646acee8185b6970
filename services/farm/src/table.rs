//! The jobs, and what may become of them: the state machine of every engine.
//!
//! An engine keeps [`Transition`]s in a log. To change something it lets the table decide, appends what was decided, and
//! applies it. Whoever applies the same log has the same table.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::engine::{
    ChangeKind, Completed, EngineError, ErrorClass, JobChange, JobFate, JobLease, JobState, JobStatus,
    Published, WorkerOffer, WorkerTally,
};
use crate::job::Job;
use crate::transition::Transition;
use crate::turn::TurnQueue;

/// The clocks may disagree by so many seconds: they are not read at the same instant, and are tuned while they run.
pub(crate) const CLOCK_SLACK_S: f64 = 1.0;

/// A worker that keeps capacity free for a job says so again before so many seconds are over; else another one may.
const KEEP_S: f64 = 300.0;

/// So many workers are remembered: machines come and go, and a new one has a new name.
const MOST_WORKERS: usize = 512;

/// What is to be appended to the log, and what is answered once it is.
#[derive(Debug)]
pub struct Decision<A> {
    /// What happens. Also a refusal may have noticed leases that ran out.
    pub transitions: Vec<Transition>,
    /// The answer, or why it is refused.
    pub answer: Result<A, EngineError>,
}

impl<A> Decision<A> {
    fn one(transition: Transition, answer: A) -> Self {
        Self { transitions: vec![transition], answer: Ok(answer) }
    }

    fn nothing(answer: Result<A, EngineError>) -> Self {
        Self { transitions: Vec::new(), answer }
    }
}

/// A job, with what only the table needs to know.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Entry {
    pub status: JobStatus,
    /// Why who holds it cannot start yet.
    pub waits: Option<String>,
    /// The worker that keeps its capacity free for it, and until when.
    #[serde(default)]
    pub kept: Option<(String, f64)>,
    /// The record that set the times to come.
    pub timed_by: u64,
}

/// All jobs. Times are seconds since 1970, by the clock of the log.
///
/// ```
/// use segwild_farm::{Job, JobTable, Needs};
/// let needs = Needs { cores: 1, memory_bytes: 0, accelerators: 0 };
/// let job = Job::new("a", "", needs);
/// let mut table = JobTable::default();
/// let decision = table.publish(&job);
/// for transition in &decision.transitions {
///     table.apply(transition, 100.0, 1);
/// }
/// assert_eq!(table.jobs().count(), 1);
/// assert!(table.publish(&job).transitions.is_empty(), "the same again changes nothing");
/// ```
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct JobTable {
    /// In the order in which they were first published.
    pub(crate) entries: BTreeMap<u64, Entry>,
    /// Where each is.
    pub(crate) ranks: BTreeMap<String, u64>,
    /// The rank of the next new job.
    pub(crate) next_rank: u64,
    /// The number of the last change that is reported to those who watch.
    pub(crate) revision: u64,
    /// How often each kind of change has happened.
    pub(crate) counts: BTreeMap<ChangeKind, u64>,
    /// What each worker has done.
    #[serde(default)]
    pub(crate) workers: BTreeMap<String, WorkerTally>,
    /// The ranks of jobs that are pending, the most urgent first.
    #[serde(skip)]
    queue: BTreeSet<(Reverse<i32>, u64)>,
    /// The ranks of jobs that somebody works on.
    #[serde(skip)]
    held: BTreeSet<u64>,
}

impl JobTable {
    /// A table of jobs that were stored one by one.
    pub(crate) fn of(entries: BTreeMap<u64, Entry>, revision: u64) -> Self {
        let ranks = entries.iter().map(|(rank, entry)| (entry.status.job.id.clone(), *rank)).collect();
        let next_rank = entries.keys().next_back().map_or(1, |rank| rank + 1);
        Self { entries, ranks, next_rank, revision, ..Self::default() }.sorted()
    }

    /// With its jobs sorted by what they wait for, as after it was read.
    pub(crate) fn sorted(mut self) -> Self {
        for rank in self.entries.keys().copied().collect::<Vec<_>>() {
            self.sort_in(rank);
        }
        self
    }

    /// Takes a job out of the sorted ones, before it changes.
    fn sort_out(&mut self, rank: u64) {
        if let Some(entry) = self.entries.get(&rank) {
            self.queue.remove(&(Reverse(entry.status.job.priority), rank));
            self.held.remove(&rank);
        }
    }

    fn sort_in(&mut self, rank: u64) {
        let Some(entry) = self.entries.get(&rank) else { return };
        match entry.status.state {
            JobState::Pending => drop(self.queue.insert((Reverse(entry.status.job.priority), rank))),
            JobState::Leased => drop(self.held.insert(rank)),
            JobState::Done | JobState::Dead => {}
        }
    }

    /// All jobs, in the order in which they were first published.
    pub fn jobs(&self) -> impl Iterator<Item = &JobStatus> {
        self.entries.values().map(|entry| &entry.status)
    }

    /// A job.
    pub fn job(&self, id: &str) -> Option<&JobStatus> {
        self.entry(id).map(|entry| &entry.status)
    }

    pub(crate) fn entry(&self, id: &str) -> Option<&Entry> {
        self.entries.get(self.ranks.get(id)?)
    }

    /// The jobs that somebody has taken and cannot start yet, and why.
    pub fn waits(&self) -> BTreeMap<String, String> {
        let waits = |entry: &Entry| Some((entry.status.job.id.clone(), entry.waits.clone()?));
        self.entries.values().filter_map(waits).collect()
    }

    /// The lease of a job that somebody works on.
    pub(crate) fn lease(&self, id: &str, lease_s: f64) -> Option<JobLease> {
        let status = self.job(id)?;
        Some(JobLease {
            job: status.job.clone(),
            attempt: status.attempt,
            worker: status.worker.clone()?,
            failures: status.failures,
            until: status.lease_until?,
            lease_s,
            checkpoint: status.checkpoint.clone(),
            alone: status.must_be_alone(),
        })
    }

    /// What became of a job whose attempt has just ended without success.
    pub(crate) fn fate(&self, id: &str) -> JobFate {
        match self.job(id) {
            Some(job) if job.state == JobState::Dead => JobFate::Dead,
            Some(job) => JobFate::Retry { due: job.due },
            None => JobFate::Released,
        }
    }

    fn held(&self, lease: &JobLease) -> Result<&JobStatus, EngineError> {
        let lost = || EngineError::Lost { job: lease.job.id.clone(), attempt: lease.attempt };
        self.job(&lease.job.id)
            .filter(|job| job.state == JobState::Leased && job.attempt == lease.attempt)
            .ok_or_else(lost)
    }

    /// What the holder of a lease may do; a zombie is refused.
    fn by_holder<A>(&self, lease: &JobLease, transition: Transition, answer: A) -> Decision<A> {
        match self.held(lease) {
            Ok(_) => Decision::one(transition, answer),
            Err(lost) => Decision::nothing(Err(lost)),
        }
    }
}

/// Decisions.
impl JobTable {
    /// Hands in a job.
    pub fn publish(&self, job: &Job) -> Decision<Published> {
        let mut job = job.clone();
        job.retry.attempts = job.retry.attempts.max(1);
        let published = match self.job(&job.id) {
            None => Published::New,
            Some(known) if known.job == job => return Decision::nothing(Ok(Published::Known)),
            Some(known) if known.job.payload == job.payload => Published::Known,
            Some(known) if known.state == JobState::Leased => {
                return Decision::nothing(Err(EngineError::InProgress(job.id)));
            }
            Some(_) => Published::Changed,
        };
        Decision::one(Transition::Published(job), published)
    }

    /// Takes the most urgent job that fits; answers with its name.
    pub fn claim(&self, offer: &WorkerOffer, now: f64) -> Decision<Option<String>> {
        let mut transitions = self.expiries(now);
        let has_it = |job: &Job| job.accelerator.is_none() || job.accelerator == offer.accelerator;
        let could_start = |job: &&JobStatus| job.due <= now && has_it(&job.job);
        let waiting = self.queue.iter().filter_map(|(_, rank)| Some(&self.entries.get(rank)?.status));
        let mut turns = TurnQueue::new(&offer.free);
        // What this worker could still keep free.
        let (mut job, mut keeps) = (None, offer.whole);
        for status in waiting.filter(could_start) {
            // One that must be alone needs the whole worker.
            let all = status.must_be_alone() && status.job.needs.fit(&offer.whole);
            let needs = if all { offer.whole } else { status.job.needs };
            if turns.turn(status.job.priority, &needs).fits {
                job = Some(status.job.id.clone());
                break;
            }
            let kept = self.entry(&status.job.id).and_then(|entry| entry.kept.as_ref());
            let kept = kept.filter(|(_, until)| *until > now);
            if !needs.fit(&keeps) || kept.is_some_and(|(worker, _)| *worker != offer.worker) {
                // Another worker gets free for it: one is enough.
                continue;
            }
            keeps = needs.taken_from(&keeps);
            turns.keep(&status.job.id, &needs);
            if kept.is_none_or(|(_, until)| *until < now + KEEP_S / 2.0) {
                let (job, worker) = (status.job.id.clone(), offer.worker.clone());
                transitions.push(Transition::Kept { job, worker, keep_s: KEEP_S });
            }
        }
        if let Some(job) = &job {
            let (worker, lease_s) = (offer.worker.clone(), offer.lease_s);
            transitions.push(Transition::Claimed { job: job.clone(), worker, lease_s });
        }
        Decision { transitions, answer: Ok(job) }
    }

    /// Says what a worker has, and that it lives.
    pub fn announce(&self, offer: &WorkerOffer) -> Decision<()> {
        let (worker, whole, accelerator) = (offer.worker.clone(), offer.whole, offer.accelerator.clone());
        Decision::one(Transition::Announced { worker, whole, accelerator }, ())
    }

    fn expiries(&self, now: f64) -> Vec<Transition> {
        let silent = |job: &&JobStatus| job.lease_until.is_some_and(|until| until < now);
        let held = self.held.iter().filter_map(|rank| Some(&self.entries.get(rank)?.status));
        held.filter(silent).map(|job| Transition::Expired { job: job.job.id.clone() }).collect()
    }

    /// Renews a lease.
    pub fn heartbeat(&self, lease: &JobLease) -> Decision<()> {
        let renewed = Transition::Renewed { job: lease.job.id.clone(), lease_s: lease.lease_s };
        self.by_holder(lease, renewed, ())
    }

    /// Ends a job as done.
    pub fn complete(&self, lease: &JobLease, outcome: &str) -> Decision<Completed> {
        let before = self.job(&lease.job.id).is_some_and(|job| {
            job.state == JobState::Done
                && job.attempt == lease.attempt
                && job.outcome.as_deref() == Some(outcome)
        });
        if before {
            return Decision::nothing(Ok(Completed::Before));
        }
        let completed = Transition::Completed { job: lease.job.id.clone(), outcome: outcome.to_owned() };
        self.by_holder(lease, completed, Completed::Now)
    }

    /// Ends an attempt that did not succeed; answers whether the job is handed back as it was.
    pub fn fail(&self, lease: &JobLease, class: ErrorClass, error: &str) -> Decision<bool> {
        let (job, text) = (lease.job.id.clone(), error.to_owned());
        match class {
            ErrorClass::Stopped => self.by_holder(lease, Transition::Released { job, reason: text }, true),
            _ => self.by_holder(lease, Transition::Failed { job, class, error: text }, false),
        }
    }

    /// Lets a dead letter try again.
    pub fn revive(&self, id: &str) -> Decision<()> {
        match self.job(id).filter(|job| job.state == JobState::Dead) {
            Some(_) => Decision::one(Transition::Revived { job: id.to_owned() }, ()),
            None => Decision::nothing(Err(EngineError::Unknown(id.to_owned()))),
        }
    }

    /// Hands back the leases of a worker, or of all.
    pub fn release(&self, worker: Option<&str>, reason: &str) -> Decision<usize> {
        let held = |job: &&JobStatus| {
            job.state == JobState::Leased && worker.is_none_or(|worker| job.worker.as_deref() == Some(worker))
        };
        let release =
            |job: &JobStatus| Transition::Released { job: job.job.id.clone(), reason: reason.to_owned() };
        let transitions: Vec<Transition> = self.jobs().filter(held).map(release).collect();
        let count = transitions.len();
        Decision { transitions, answer: Ok(count) }
    }

    /// Forgets jobs, but for those that somebody works on.
    pub fn withdraw(&self, ids: &[String]) -> Decision<usize> {
        let idle = |id: &&String| self.job(id).is_some_and(|job| job.state != JobState::Leased);
        let withdraw = |id: &String| Transition::Withdrawn { job: id.clone() };
        let transitions: Vec<Transition> = ids.iter().filter(idle).map(withdraw).collect();
        let count = transitions.len();
        Decision { transitions, answer: Ok(count) }
    }

    /// Notes that a holder cannot start yet, or has started.
    pub fn note_wait(&self, lease: &JobLease, reason: Option<&str>) -> Decision<()> {
        let job = lease.job.id.clone();
        self.by_holder(lease, Transition::Waited { job, reason: reason.map(str::to_owned) }, ())
    }

    /// Notes that a worker takes no jobs for now, or takes them again. Who pauses on says so again: that is a sign of life.
    pub fn note_pause(&self, worker: &str, reason: Option<&str>) -> Decision<()> {
        let pauses = self.workers.get(worker).is_some_and(|tally| tally.paused.is_some());
        if reason.is_none() && !pauses {
            return Decision::nothing(Ok(()));
        }
        let (worker, reason) = (worker.to_owned(), reason.map(str::to_owned));
        Decision::one(Transition::Paused { worker, reason }, ())
    }

    /// Notes where the state of a holder's work is stored.
    pub fn checkpoint(&self, lease: &JobLease, artefact: &str) -> Decision<()> {
        let (job, checkpoint) = (lease.job.id.clone(), artefact.to_owned());
        self.by_holder(lease, Transition::Stored { job, checkpoint }, ())
    }

    /// The rests that would end later than their own length from now: they were started before the clock was set back.
    pub(crate) fn rests_too_long(&self, now: f64) -> Vec<(String, f64)> {
        let too_far = |job: &JobStatus| job.due - now - job.job.retry.delay_s(job.failures);
        let resting = |job: &&JobStatus| job.state == JobState::Pending && too_far(job) > CLOCK_SLACK_S;
        self.jobs().filter(resting).map(|job| (job.job.id.clone(), too_far(job))).collect()
    }
}

/// What follows.
impl JobTable {
    /// Applies a transition of the log's record number `record`, which was appended at `now`; returns what is reported to
    /// those who watch. A transition about a job that is not there changes nothing.
    pub fn apply(&mut self, transition: &Transition, now: f64, record: u64) -> Vec<JobChange> {
        let rank_of = |table: &Self| transition.job().and_then(|id| table.ranks.get(id)).copied();
        if let Some(rank) = rank_of(self) {
            self.sort_out(rank);
        }
        let changes = self.follow(transition, now, record);
        if let Some(rank) = rank_of(self) {
            self.sort_in(rank);
        }
        changes
    }

    fn follow(&mut self, transition: &Transition, now: f64, record: u64) -> Vec<JobChange> {
        match transition {
            Transition::Published(job) => return self.published(job, now, record),
            Transition::ClockSet { seconds, since } => {
                self.move_times(*seconds, *since);
                for tally in self.workers.values_mut().filter(|tally| tally.seen_by < *since) {
                    tally.seen += seconds;
                }
            }
            Transition::TimesMoved { seconds, since } => self.move_times(*seconds, *since),
            Transition::Announced { .. } | Transition::Paused { .. } => {
                self.tally(transition, None, now, record);
            }
            _ => {}
        }
        let Some(rank) = transition.job().and_then(|id| self.ranks.get(id)).copied() else {
            return Vec::new();
        };
        if matches!(transition, Transition::Withdrawn { .. }) {
            if let Some(entry) = self.entries.remove(&rank) {
                self.ranks.remove(&entry.status.job.id);
            }
            return Vec::new();
        }
        let Some(entry) = self.entries.get_mut(&rank) else { return Vec::new() };
        let holder = entry.status.worker.clone();
        let noted = entry.follow(transition, now, record);
        let (id, attempt) = (entry.status.job.id.clone(), entry.status.attempt);
        self.tally(transition, holder, now, record);
        noted.into_iter().map(|(kind, detail)| self.change(now, &id, kind, attempt, detail)).collect()
    }

    /// Books what a transition says of the worker that held the job before it, or takes it.
    fn tally(&mut self, transition: &Transition, holder: Option<String>, now: f64, record: u64) {
        let worker = match transition {
            Transition::Claimed { worker, .. }
            | Transition::Kept { worker, .. }
            | Transition::Announced { worker, .. }
            | Transition::Paused { worker, .. } => Some(worker.clone()),
            _ => holder,
        };
        let Some(worker) = worker else { return };
        let tally = self.workers.entry(worker).or_default();
        match transition {
            Transition::Completed { .. } => tally.done += 1,
            Transition::Failed { .. } => tally.failed += 1,
            Transition::Released { .. } => tally.returned += 1,
            Transition::Expired { .. } => tally.silent += 1,
            Transition::Claimed { .. } => tally.paused = None,
            Transition::Paused { reason, .. } => tally.paused.clone_from(reason),
            Transition::Announced { whole, accelerator, .. } => {
                tally.whole = Some(*whole);
                tally.accelerator.clone_from(accelerator);
            }
            _ => {}
        }
        // Others note that it fell silent, and may hand back what it held: that is no sign of life.
        if !matches!(transition, Transition::Expired { .. } | Transition::Released { .. }) {
            (tally.seen, tally.seen_by) = (now, record);
        }
        self.forget_worker();
    }

    /// Forgets the worker that was not seen for longest, where there are too many.
    fn forget_worker(&mut self) {
        if self.workers.len() > MOST_WORKERS {
            let longest = self.workers.iter().min_by(|(_, a), (_, b)| a.seen.total_cmp(&b.seen));
            if let Some(name) = longest.map(|(name, _)| name.clone()) {
                self.workers.remove(&name);
            }
        }
    }

    fn change(&mut self, time: f64, job: &str, kind: ChangeKind, attempt: u32, detail: String) -> JobChange {
        self.revision += 1;
        *self.counts.entry(kind).or_default() += 1;
        JobChange { revision: self.revision, time, job: job.to_owned(), kind, attempt, detail }
    }

    fn published(&mut self, job: &Job, now: f64, record: u64) -> Vec<JobChange> {
        let attempt = match self.ranks.get(&job.id).and_then(|rank| self.entries.get_mut(rank)) {
            Some(entry) => {
                let same = entry.status.job.payload == job.payload;
                entry.status.job = job.clone();
                if same {
                    return Vec::new();
                }
                let attempt = entry.status.attempt;
                *entry = Entry::new(job, attempt, now, record);
                attempt
            }
            None => {
                self.ranks.insert(job.id.clone(), self.next_rank);
                self.entries.insert(self.next_rank, Entry::new(job, 0, now, record));
                self.next_rank += 1;
                0
            }
        };
        vec![self.change(now, &job.id, ChangeKind::Published, attempt, String::new())]
    }

    fn move_times(&mut self, seconds: f64, since: u64) {
        for (_, until) in self.entries.values_mut().filter_map(|entry| entry.kept.as_mut()) {
            *until += seconds;
        }
        for entry in self.entries.values_mut().filter(|entry| entry.timed_by < since) {
            let status = &mut entry.status;
            match status.state {
                JobState::Pending => status.due += seconds,
                JobState::Leased => {
                    status.lease_until = status.lease_until.map(|until| until + seconds);
                    status.started = status.started.map(|started| started + seconds);
                }
                JobState::Done | JobState::Dead => {}
            }
        }
    }
}

impl Entry {
    fn new(job: &Job, attempt: u32, now: f64, record: u64) -> Self {
        let status = JobStatus {
            job: job.clone(),
            state: JobState::Pending,
            attempt,
            failures: 0,
            worker: None,
            lease_until: None,
            due: now,
            started: None,
            ended: None,
            outcome: None,
            error: None,
            error_class: None,
            checkpoint: None,
            silences: 0,
        };
        Self { status, waits: None, kept: None, timed_by: record }
    }

    /// Follows a transition, and says what of it is reported.
    fn follow(&mut self, transition: &Transition, now: f64, record: u64) -> Vec<(ChangeKind, String)> {
        match transition {
            Transition::Waited { reason, .. } => {
                self.waits.clone_from(reason);
                let kind = if reason.is_some() { ChangeKind::Waits } else { ChangeKind::Began };
                return vec![(kind, reason.clone().unwrap_or_default())];
            }
            Transition::Stored { checkpoint, .. } => {
                self.status.checkpoint = Some(checkpoint.clone());
                return Vec::new();
            }
            Transition::Kept { worker, keep_s, .. } => {
                self.kept = Some((worker.clone(), now + keep_s));
                return Vec::new();
            }
            _ => (self.timed_by, self.kept) = (record, None),
        }
        match transition {
            Transition::Claimed { worker, lease_s, .. } => {
                let status = &mut self.status;
                status.state = JobState::Leased;
                status.attempt += 1;
                status.worker = Some(worker.clone());
                status.lease_until = Some(now + lease_s);
                (status.started, status.ended) = (Some(now), None);
                vec![(ChangeKind::Claimed, worker.clone())]
            }
            Transition::Renewed { lease_s, .. } => {
                self.status.lease_until = Some(now + lease_s);
                Vec::new()
            }
            Transition::Expired { .. } => {
                let error = format!("{} fell silent", self.status.worker.as_deref().unwrap_or("its worker"));
                self.status.silences += 1;
                let failed = self.failed(now, ErrorClass::Retryable, &error);
                vec![(ChangeKind::Expired, error), failed]
            }
            Transition::Completed { outcome, .. } => {
                self.end(JobState::Done, now, now);
                self.status.outcome = Some(outcome.clone());
                (self.status.error, self.status.error_class) = (None, None);
                vec![(ChangeKind::Completed, outcome.clone())]
            }
            Transition::Failed { class, error, .. } => vec![self.failed(now, *class, error)],
            Transition::Released { reason, .. } => {
                self.end(JobState::Pending, now, now);
                vec![(ChangeKind::Released, reason.clone())]
            }
            Transition::Revived { .. } => {
                self.status.state = JobState::Pending;
                (self.status.failures, self.status.silences) = (0, 0);
                self.status.due = now;
                vec![(ChangeKind::Revived, String::new())]
            }
            Transition::RestEnded { .. } => {
                self.status.due = now;
                Vec::new()
            }
            Transition::Published(_)
            | Transition::Withdrawn { .. }
            | Transition::Waited { .. }
            | Transition::Stored { .. }
            | Transition::Kept { .. }
            | Transition::Announced { .. }
            | Transition::Paused { .. }
            | Transition::ClockSet { .. }
            | Transition::TimesMoved { .. } => Vec::new(),
        }
    }

    /// Ends an attempt.
    fn end(&mut self, state: JobState, now: f64, due: f64) {
        let status = &mut self.status;
        status.state = state;
        (status.worker, status.lease_until, status.ended, status.due) = (None, None, Some(now), due);
        self.waits = None;
    }

    /// Ends a failed attempt, and counts it unless the machine is at fault.
    fn failed(&mut self, now: f64, class: ErrorClass, error: &str) -> (ChangeKind, String) {
        let status = &mut self.status;
        status.failures += u32::from(class != ErrorClass::Shortage);
        (status.error, status.error_class) = (Some(error.to_owned()), Some(class));
        let (failures, retry) = (status.failures, status.job.retry);
        if class == ErrorClass::Fatal || class == ErrorClass::Retryable && failures >= retry.attempts {
            self.end(JobState::Dead, now, now);
            return (ChangeKind::Died, error.to_owned());
        }
        self.end(JobState::Pending, now, now + retry.delay_s(failures));
        (ChangeKind::Retried, error.to_owned())
    }
}
