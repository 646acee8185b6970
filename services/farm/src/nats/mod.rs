//! The engine for many machines: a log on JetStream.
//!
//! ```text
//! stream SEGWILD_NAME              the log: one message a record, each appended only if the last one is the one its writer
//!                                  knew (`Nats-Expected-Last-Sequence`)
//! object store SEGWILD_NAME        snapshots: the table as it is after a record; the log forgets what a snapshot covers
//! ```
//!
//! Every handle reads the log and applies it to its own [`JobTable`]; so priorities, needs, fences, dead letters and retries
//! are those of the embedded engine. A record happens when the server stores it, by the server's clock.
//!
//! An append whose answer is lost is looked for in the log, and sent again under its own name where it is not there. A server
//! that lost the end of its log in a power cut has another record where a handle read one: the handle forgets what it knew
//! and reads the log again. What was appended after a record that is lost names it (`after`), and is void.

mod address;
mod clock;
mod error;
mod record;
mod server;

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

use async_nats::jetstream::context::CreateStreamErrorKind;
use async_nats::jetstream::{self, stream};
use async_nats::{ConnectErrorKind, ConnectOptions};
use segwild_flow::clock::steady;
use segwild_flow::lock;
use serde::{Deserialize, Serialize};

pub use self::address::{FarmAccess, FarmAddress, FarmAddressError};
use self::clock::ServerClock;
use self::error::FarmServerError;
pub use self::record::FarmKey;
use self::record::{LogRecord, LogRecordError};
use self::server::{Appended, LogServer, REQUEST_TIMEOUT, RequestError, persist};
use crate::artefacts::{ArtefactError, JetStreamArtefacts, StoreAddressError};
use crate::engine::{ChangeKind, EngineError, FarmLogState, JobChange};
use crate::log::TransitionLog;
use crate::pending::Pending;
use crate::table::{Decision, JobTable};
use crate::transition::Transition;

/// A handle gives up after so long without an answer. Whoever works goes on meanwhile, and calls again.
pub const USUAL_PATIENCE: Duration = Duration::from_secs(30);
/// The log is compacted at records whose number this divides. One that starts reads at most twice as many.
const COMPACT_EVERY: u64 = 1024;
/// So many of the last changes are kept for those who watch.
const KEPT_CHANGES: usize = 20_000;
/// A record that is sent again within this time is not stored twice.
const DUPLICATE_WINDOW: Duration = Duration::from_secs(120);
/// A server that does not answer for longer was away: nobody could renew a lease meanwhile, and all of them last longer by as
/// much.
const OUTAGE: Duration = Duration::from_secs(8);
/// Version of snapshots.
const SNAPSHOT_FORMAT: u32 = 1;

/// The jobs of a farm.
pub struct NatsEngine {
    address: FarmAddress,
    key: Option<FarmKey>,
    writer: String,
    server: LogServer,
    known: Mutex<Known>,
    runtime: Option<tokio::runtime::Runtime>,
}

/// What a handle knows of the log.
#[derive(Default)]
struct Known {
    table: JobTable,
    changes: VecDeque<JobChange>,
    /// The last record that was applied, and its name; 0 before the first.
    tail: u64,
    tail_id: String,
    clock: ServerClock,
    /// The server's clock was set, by this much, before that record; the log does not say so yet.
    unsaid_jump: Option<(f64, u64)>,
    jumped: Vec<f64>,
    /// The server did not answer for so many seconds, after that record; the log does not say so yet.
    silent: Option<(f64, u64)>,
    /// How long the log was, and what reading it has cost.
    log: FarmLogState,
    /// What the server's clock showed when it stored the newest record, less what the steady clock of this machine showed when
    /// that was read. For those who only watch: `clock` knows nothing before this handle appends.
    ahead: Option<f64>,
}

#[derive(Serialize, Deserialize)]
struct TableSnapshot {
    format: u32,
    covers: u64,
    id: String,
    table: JobTable,
    changes: VecDeque<JobChange>,
    /// The mark of the key of who made it, empty where there was none; absent in those of earlier versions. It is no signature:
    /// who may write to the farm's bucket may write this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    key: Option<String>,
}

impl Drop for NatsEngine {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl fmt::Debug for NatsEngine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "NatsEngine({})", self.address)
    }
}

impl NatsEngine {
    /// Connects to a farm's servers, and makes the farm where there is none. `writer` is who appends, for people.
    ///
    /// # Errors
    /// [`EngineError::Server`]: none answers within the patience, one refuses, JetStream is not switched on, what is on the
    /// server is no log of a farm that this version reads.
    pub fn connect(
        address: &FarmAddress,
        access: &FarmAccess,
        writer: &str,
        patience: Duration,
    ) -> Result<NatsEngine, EngineError> {
        let fail = |reason| failure_of(address, reason);
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("farm client")
            .enable_all()
            .build()
            .map_err(|e| fail(FarmServerError::client(e)))?;
        let (to, how) = (address.clone(), access.clone());
        let server = wait(&runtime, async move { open(&to, &how, patience).await }).map_err(fail)?;
        let engine = NatsEngine {
            address: address.clone(),
            key: access.key.clone(),
            writer: writer.to_owned(),
            server,
            known: Mutex::default(),
            runtime: Some(runtime),
        };
        engine.read_on(&mut engine.lock(), None)?;
        Ok(engine)
    }

    /// Where it is.
    pub fn address(&self) -> &FarmAddress {
        &self.address
    }

    /// How many records were applied so far, over all machines and ever.
    pub fn records(&self) -> u64 {
        self.lock().tail
    }

    /// The store of artefacts that the farm's own servers keep: for small farms, which then need no other.
    ///
    /// # Errors
    /// When the server does not make it.
    pub fn artefacts(&self) -> Result<JetStreamArtefacts, ArtefactError> {
        let bucket = format!("SEGWILD_{}_ARTEFACTS", self.address.name());
        let handle = self.runtime.as_ref().map(|runtime| runtime.handle().clone());
        let Some(handle) = handle else {
            return Err(ArtefactError::Address { address: bucket, reason: StoreAddressError::Ended });
        };
        JetStreamArtefacts::open(self.server.context.clone(), &bucket, handle)
    }

    /// Lets all times to come move closer, as if so much time had passed: for tests of what takes hours.
    ///
    /// # Errors
    /// When the log cannot be written.
    pub fn pass(&self, seconds: f64) -> Result<(), EngineError> {
        let moved = |_: &JobTable, _| Decision {
            transitions: vec![Transition::TimesMoved { seconds: -seconds, since: u64::MAX }],
            answer: Ok(()),
        };
        self.transact(moved, |_, ()| ())
    }

    fn lock(&self) -> MutexGuard<'_, Known> {
        lock(&self.known)
    }

    fn failure(&self, reason: FarmServerError) -> EngineError {
        failure_of(&self.address, reason)
    }

    fn ask<T: Send + 'static>(
        &self,
        request: impl Future<Output = Result<T, FarmServerError>> + Send + 'static,
    ) -> Result<T, EngineError> {
        let Some(runtime) = &self.runtime else { return Err(self.failure(FarmServerError::Closed)) };
        wait(runtime, request).map_err(|reason| self.failure(reason))
    }

    /// Applies what was appended since; stops right after the record named `until`.
    fn read_on(&self, known: &mut Known, until: Option<&str>) -> Result<ReadOn, EngineError> {
        let (began, before) = (Instant::now(), known.log.read_records);
        let read = self.read_records(known, until);
        // To find nothing new costs a request, and is no reading.
        if known.log.read_records > before {
            known.log.read_s += began.elapsed().as_secs_f64();
        }
        read
    }

    fn read_records(&self, known: &mut Known, until: Option<&str>) -> Result<ReadOn, EngineError> {
        loop {
            if !self.is_still_there(known)? {
                self.start_over(known)?;
            }
            loop {
                let next = known.tail + 1;
                let Some(record) = self.ask(self.server.clone().record(next))? else { break };
                let (id, read) = LogRecord::decode(&record.payload, self.address.name(), self.key.as_ref());
                let void = matches!(read, Err(LogRecordError::Void));
                let without_key = self.key.is_none() && LogRecord::is_signed(&record.payload);
                known.log.void_records += u64::from(void || without_key);
                known.ahead = Some(record.time - steady().seconds);
                let applied = match read {
                    Ok(read) if read.after == known.tail_id => {
                        known.apply(&read.transitions, record.time, next);
                        true
                    }
                    Err(reason @ LogRecordError::Newer) => {
                        return Err(self.failure(FarmServerError::Record { record: next, reason }));
                    }
                    Ok(_) | Err(LogRecordError::Void) => {
                        tracing::warn!(record = next, farm = %self.address, "a record of the farm's log is void");
                        false
                    }
                };
                (known.tail, known.tail_id) = (next, id);
                known.log.read_records += 1;
                if until == Some(known.tail_id.as_str()) {
                    return Ok(ReadOn::Met { stored: record.time, applied });
                }
            }
            // Nothing follows: because that is the end, or because somebody compacted the log meanwhile.
            let extent = self.ask(self.server.clone().extent())?;
            if extent.last == known.tail {
                known.log.records = extent.count;
                return Ok(ReadOn::End);
            }
            if extent.last > known.tail && extent.first <= known.tail + 1 {
                let missing = known.tail + 1;
                if self.ask(self.server.clone().record(missing))?.is_none() {
                    return Err(self.failure(FarmServerError::NoRecord(missing)));
                }
                continue;
            }
            *known = known.forgotten();
        }
    }

    /// Whether the last record that was applied is in the log as it was.
    fn is_still_there(&self, known: &mut Known) -> Result<bool, EngineError> {
        if known.tail == 0 {
            return Ok(false);
        }
        let Some(record) = self.ask(self.server.clone().record(known.tail))? else { return Ok(false) };
        // After a snapshot this record is the first one whose time is known.
        if known.ahead.is_none() {
            known.ahead = Some(record.time - steady().seconds);
        }
        Ok(LogRecord::decode(&record.payload, self.address.name(), None).0 == known.tail_id)
    }

    /// Reads the table again: from the snapshot that the log starts at, or from its first record.
    fn start_over(&self, known: &mut Known) -> Result<(), EngineError> {
        if known.tail > 0 {
            tracing::warn!(farm = %self.address, "the farm's log is another one; it is read again");
        }
        *known = known.forgotten();
        let extent = self.ask(self.server.clone().extent())?;
        // A log that was compacted starts at the last record that its snapshot covers; where the server lost that one, too,
        // the log is empty and goes on after it.
        let covers = if extent.count == 0 { extent.last } else { extent.first };
        if covers <= 1 {
            return Ok(());
        }
        let Some(bytes) = self.ask(self.server.clone().snapshot(covers))? else {
            // Compacted again since.
            let now = self.ask(self.server.clone().extent())?;
            if now.first > extent.first {
                return self.start_over(known);
            }
            return Err(self.failure(FarmServerError::NoSnapshot(covers)));
        };
        let snapshot: TableSnapshot = serde_json::from_slice(&bytes)
            .map_err(|source| self.failure(FarmServerError::Snapshot { covers, source }))?;
        if snapshot.format != SNAPSHOT_FORMAT || snapshot.covers != covers {
            let (found, known) = (snapshot.format, SNAPSHOT_FORMAT);
            return Err(self.failure(FarmServerError::SnapshotFormat { covers, found, known }));
        }
        if snapshot.key.is_some_and(|mark| mark != self.key_mark()) {
            // Who made it may have taken records for void that are not.
            tracing::warn!(farm = %self.address, "the snapshot of the farm's log was made with another key");
            known.log.void_records += 1;
        }
        (known.table, known.changes) = (snapshot.table.sorted(), snapshot.changes);
        (known.tail, known.tail_id) = (covers, snapshot.id);
        Ok(())
    }

    /// Appends transitions after what is known, and applies them; `false` when somebody else was first.
    fn append(&self, known: &mut Known, transitions: Vec<Transition>) -> Result<bool, EngineError> {
        let (before, after) = (known.tail, known.tail_id.clone());
        let id = self.record_name()?;
        let record = LogRecord { id: id.clone(), after, transitions, writer: self.writer.clone() };
        let bytes = record.encode(self.address.name(), self.key.as_ref());
        let began = Instant::now();
        loop {
            let sent = steady().seconds;
            let appended = self.ask(self.server.clone().append(id.clone(), bytes.clone(), before))?;
            let answered = steady().seconds;
            match self.read_on(known, Some(&id))? {
                ReadOn::Met { stored, applied } => {
                    // Of a record whose answer was lost it is not known when it arrived.
                    if matches!(appended, Appended::Yes)
                        && let Some(jump) = known.clock.observe(stored, sent, answered)
                    {
                        known.unsaid_jump = Some((jump, known.tail));
                    }
                    self.compact_at(known);
                    return Ok(applied);
                }
                // It is not there, and may still come: it is sent again under its name, and stored once.
                ReadOn::End if known.tail == before && known.tail_id == record.after => match appended {
                    Appended::Unknown(reason) if began.elapsed() > self.server.patience => {
                        return Err(self.failure(FarmServerError::NotAppended(reason)));
                    }
                    Appended::Unknown(_) => {}
                    Appended::Yes | Appended::No => return Ok(false),
                },
                ReadOn::End => return Ok(false),
            }
        }
    }

    /// The mark of this handle's key; empty where it has none.
    fn key_mark(&self) -> String {
        self.key.as_ref().map_or_else(String::new, |key| key.mark(self.address.name()))
    }

    /// A name that no other record has.
    fn record_name(&self) -> Result<String, EngineError> {
        let mut bytes = [0; 16];
        getrandom::fill(&mut bytes).map_err(|error| self.failure(FarmServerError::NoRandom(error)))?;
        Ok(format!("{:032x}", u128::from_le_bytes(bytes)))
    }

    /// Compacts the log if this record is one to do it at. A log that is not compacted is longer, and nothing else: the
    /// next one does it.
    fn compact_at(&self, known: &Known) {
        let sequence = known.tail;
        if !sequence.is_multiple_of(COMPACT_EVERY) {
            return;
        }
        // Where most of the log is void for this handle, it has another key than the farm: its table is not the farm's.
        if known.log.void_records > known.log.read_records / 2 {
            tracing::warn!(farm = %self.address, "most of the farm's log is void here: it is not compacted with this key");
            return;
        }
        let snapshot = TableSnapshot {
            format: SNAPSHOT_FORMAT,
            covers: sequence,
            id: known.tail_id.clone(),
            table: known.table.clone(),
            changes: known.changes.clone(),
            key: Some(self.key_mark()),
        };
        let compacted = serde_json::to_vec(&snapshot)
            .map_err(|e| self.failure(FarmServerError::client(e)))
            .and_then(|bytes| self.ask(self.server.clone().compact(sequence, bytes)));
        if let Err(error) = compacted {
            tracing::warn!(%error, "the farm's log could not be compacted");
        }
    }

    /// Reads the log, lets it say what only this handle knows of the time, and returns the time.
    fn settle(&self, known: &mut Known) -> Result<f64, EngineError> {
        loop {
            let (began, tail) = (Instant::now(), known.tail);
            let read = self.read_on(known, None);
            let silence = began.elapsed();
            if silence > OUTAGE {
                known.silent.get_or_insert((0.0, tail)).0 += silence.as_secs_f64();
            }
            read?;
            // Others wrote meanwhile: the server was not away, only this machine was.
            known.silent = known.silent.filter(|(_, tail)| known.tail == *tail);
            if let Some((seconds, since)) = known.unsaid_jump {
                self.append(known, vec![Transition::ClockSet { seconds, since }])?;
            } else if let Some((seconds, since)) = known.silent {
                let since = since + 1;
                if self.append(known, vec![Transition::TimesMoved { seconds, since }])? {
                    known.silent = None;
                }
            } else if let Some(now) = known.clock.now(steady().seconds) {
                return Ok(now);
            } else if self.append(known, Vec::new())? {
                // The server has stored a record: its clock is known, unless the answer was lost.
                let Some(now) = known.clock.now(steady().seconds) else { continue };
                let ended = |(job, _)| Transition::RestEnded { job };
                let over: Vec<Transition> = known.table.rests_too_long(now).into_iter().map(ended).collect();
                if !over.is_empty() {
                    self.append(known, over)?;
                }
            }
        }
    }
}

/// How far reading went.
enum ReadOn {
    /// To the end.
    End,
    /// To the record that was searched.
    Met {
        /// When the server stored it.
        stored: f64,
        /// Whether it counts: a void one does not.
        applied: bool,
    },
}

impl Known {
    fn apply(&mut self, transitions: &[Transition], now: f64, record: u64) {
        for transition in transitions {
            self.changes.extend(self.table.apply(transition, now, record));
            match transition {
                Transition::ClockSet { seconds, .. } => {
                    self.clock.set(*seconds);
                    self.unsaid_jump = None;
                    self.jumped.push(*seconds);
                }
                // Another handle has met the same outage.
                Transition::TimesMoved { .. } => self.silent = None,
                _ => {}
            }
        }
        let surplus = self.changes.len().saturating_sub(KEPT_CHANGES);
        self.changes.drain(..surplus);
    }

    /// What remains when the log is another one.
    fn forgotten(&self) -> Known {
        let (clock, log, ahead) = (self.clock, self.log, self.ahead);
        Known { clock, jumped: self.jumped.clone(), log, ahead, ..Known::default() }
    }
}

impl TransitionLog for NatsEngine {
    fn transact<A, R>(
        &self,
        decide: impl Fn(&JobTable, f64) -> Decision<A>,
        then: impl FnOnce(&JobTable, A) -> R,
    ) -> Result<R, EngineError> {
        let mut known = self.lock();
        loop {
            let now = self.settle(&mut known)?;
            let Decision { transitions, answer } = decide(&known.table, now);
            if transitions.is_empty() || self.append(&mut known, transitions)? {
                return answer.map(|answer| then(&known.table, answer));
            }
        }
    }

    fn with_table<R>(&self, read: impl FnOnce(&JobTable) -> R) -> Result<R, EngineError> {
        let mut known = self.lock();
        self.read_on(&mut known, None)?;
        Ok(read(&known.table))
    }

    fn changes(&self, after: u64, limit: usize) -> Result<Vec<JobChange>, EngineError> {
        let mut known = self.lock();
        self.read_on(&mut known, None)?;
        // Revisions grow.
        let start = known.changes.partition_point(|change| change.revision <= after);
        Ok(known.changes.range(start..).take(limit).cloned().collect())
    }

    fn count_of(&self, kind: ChangeKind) -> Result<u64, EngineError> {
        self.with_table(|table| table.counts.get(&kind).copied().unwrap_or_default())
    }

    fn met_jumps(&self) -> Result<Vec<f64>, EngineError> {
        let mut known = self.lock();
        self.read_on(&mut known, None)?;
        Ok(std::mem::take(&mut known.jumped))
    }

    fn extent_read(&self) -> Option<FarmLogState> {
        Some(self.lock().log)
    }

    fn time_read(&self) -> Option<f64> {
        Some(self.lock().ahead? + steady().seconds)
    }
}

/// What a record of a farm's log says, for programs that read one; `None` where it is void, or a newer version's.
pub fn transitions(record: &[u8], farm: &str, key: Option<&FarmKey>) -> Option<Vec<Transition>> {
    Some(LogRecord::decode(record, farm, key).1.ok()?.transitions)
}

/// The error of an engine whose server at this address does not serve.
fn failure_of(address: &FarmAddress, reason: FarmServerError) -> EngineError {
    EngineError::Server { server: address.to_string(), reason: Box::new(reason) }
}

/// Waits for a future of the runtime, from a thread that is none of its own.
fn wait<T: Send + 'static>(
    runtime: &tokio::runtime::Runtime,
    future: impl Future<Output = Result<T, FarmServerError>> + Send + 'static,
) -> Result<T, FarmServerError> {
    let pending = Pending::start(runtime.handle(), future);
    pending.wait().unwrap_or_else(|_| Err(FarmServerError::Ended))
}

/// Whether an error is, or comes from, a certificate that is not trusted: another try ends in the same way.
fn is_untrusted(error: &(dyn std::error::Error + 'static)) -> bool {
    let wrong = |error: &(dyn std::error::Error + 'static)| {
        // An error of the system that wraps another one is no source of it.
        let inner = error.downcast_ref::<std::io::Error>().and_then(|error| error.get_ref());
        let tls = inner.and_then(|inner| inner.downcast_ref::<rustls::Error>());
        let tls = tls.or_else(|| error.downcast_ref::<rustls::Error>());
        matches!(tls, Some(rustls::Error::InvalidCertificate(_)))
    };
    std::iter::successors(Some(error), |&error| error.source()).any(wrong)
}

/// Connects, and makes the farm's log where there is none.
async fn open(
    address: &FarmAddress,
    access: &FarmAccess,
    patience: Duration,
) -> Result<LogServer, FarmServerError> {
    let mut options = ConnectOptions::new()
        .name("segwild")
        .require_tls(address.tls())
        .connection_timeout(REQUEST_TIMEOUT)
        .request_timeout(Some(REQUEST_TIMEOUT))
        .max_reconnects(None);
    if let Some(file) = &access.credentials {
        let wrong = |source| FarmServerError::Credentials { file: file.clone(), source };
        options = options.credentials_file(file).await.map_err(wrong)?;
    }
    if let Some(file) = &access.certificates {
        // The client would try it again and again.
        let wrong = |source| FarmServerError::Certificates { file: file.clone(), source };
        std::fs::File::open(file).map_err(wrong)?;
        options = options.add_root_certificates(file.clone());
    }
    let connect = || async {
        options.clone().connect(address.servers()).await.map_err(|error| match error.kind() {
            ConnectErrorKind::Authentication | ConnectErrorKind::AuthorizationViolation => {
                RequestError::Final(FarmServerError::Refused(error.into()))
            }
            _ if is_untrusted(&error) => RequestError::Final(FarmServerError::Untrusted(error.into())),
            _ => RequestError::passing(error),
        })
    };
    let client = persist(patience, connect).await?;
    let mut context = jetstream::new(client);
    context.set_timeout(REQUEST_TIMEOUT);
    let stream_name = format!("SEGWILD_{}", address.name());
    let subject = format!("segwild.{}.log", address.name());
    let config = stream::Config {
        name: stream_name.clone(),
        subjects: vec![subject.clone()],
        storage: stream::StorageType::File,
        duplicate_window: DUPLICATE_WINDOW,
        description: Some("log of a segwild farm".into()),
        ..stream::Config::default()
    };
    let make = || async {
        // One that is there is taken as it is: its operator may keep it in several copies.
        let made = context.get_or_create_stream(config.clone()).await;
        made.map_err(|error| match error.kind() {
            CreateStreamErrorKind::JetStreamUnavailable => {
                RequestError::Passing(FarmServerError::NoJetStream)
            }
            _ => RequestError::passing(error),
        })
    };
    let stream = persist(patience, make).await?;
    if !stream.cached_info().config.subjects.contains(&subject) {
        return Err(FarmServerError::NoLog { stream: stream_name, subject });
    }
    Ok(LogServer { context, stream, subject, bucket: stream_name, patience })
}
