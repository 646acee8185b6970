//! Records of the log, as messages.

use prost::Message;
use segwild_proto::v1::{self, job_transition::Change};

use crate::engine::ErrorClass;
use crate::job::{Job, Needs, Retry};
use crate::transition::Transition;

/// What a signature of a farm's records is derived for.
const PURPOSE: &str = "segwild farm record v1";

/// What is signed to mark whose a snapshot is. No record has these bytes: they are no message.
const SNAPSHOT_MARK: &[u8] = b"segwild farm snapshot";

/// Why a record cannot be applied.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum LogRecordError {
    /// Nobody who may has written it, or not after what is before it.
    #[error("it is void")]
    Void,
    /// A newer version of the program has written it.
    #[error("a newer version of segwild wrote it; update segwild on this machine")]
    Newer,
}

/// The key that a farm's machines share.
#[derive(Clone)]
pub struct FarmKey([u8; 32]);

impl FarmKey {
    /// The key that follows from a secret text.
    pub fn of(secret: &str) -> Self {
        Self(blake3::derive_key(PURPOSE, secret.trim().as_bytes()))
    }

    fn sign(&self, farm: &str, unsigned: &[u8]) -> blake3::Hash {
        let mut hasher = blake3::Hasher::new_keyed(&self.0);
        hasher.update(&(farm.len() as u64).to_le_bytes()).update(farm.as_bytes()).update(unsigned);
        hasher.finalize()
    }

    /// What shows whether two keys of a farm are the same, and nothing else of them.
    pub(super) fn mark(&self, farm: &str) -> String {
        self.sign(farm, SNAPSHOT_MARK).to_hex().to_string()
    }
}

impl std::fmt::Debug for FarmKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("FarmKey(…)")
    }
}

/// A record to append.
#[derive(Debug, PartialEq)]
pub(super) struct LogRecord {
    pub id: String,
    pub after: String,
    pub transitions: Vec<Transition>,
    pub writer: String,
}

impl LogRecord {
    /// Its bytes, signed if there is a key.
    pub fn encode(&self, farm: &str, key: Option<&FarmKey>) -> Vec<u8> {
        let mut message = v1::FarmRecord {
            id: self.id.clone(),
            after: self.after.clone(),
            transitions: self.transitions.iter().map(message_of).collect(),
            writer: self.writer.clone(),
            signature: Vec::new(),
        };
        if let Some(key) = key {
            message.signature = key.sign(farm, &message.encode_to_vec()).as_bytes().to_vec();
        }
        message.encode_to_vec()
    }

    /// Reads a record: its name, and the record where it may be applied.
    pub fn decode(
        bytes: &[u8],
        farm: &str,
        key: Option<&FarmKey>,
    ) -> (String, Result<LogRecord, LogRecordError>) {
        let Ok(mut message) = v1::FarmRecord::decode(bytes) else {
            return (String::new(), Err(LogRecordError::Void));
        };
        let id = message.id.clone();
        if let Some(key) = key {
            let signature = std::mem::take(&mut message.signature);
            let right = key.sign(farm, &message.encode_to_vec());
            // Compared in constant time: blake3's `Hash` is.
            if <[u8; 32]>::try_from(signature).map(blake3::Hash::from) != Ok(right) {
                return (id, Err(LogRecordError::Void));
            }
        }
        let transitions: Result<Vec<_>, _> = message.transitions.into_iter().map(transition_of).collect();
        let record = |transitions| LogRecord {
            id: id.clone(),
            after: message.after,
            transitions,
            writer: message.writer,
        };
        let record = transitions.map(record);
        (id, record)
    }

    /// Whether a record has a signature, right or wrong.
    pub fn is_signed(bytes: &[u8]) -> bool {
        v1::FarmRecord::decode(bytes).is_ok_and(|message| !message.signature.is_empty())
    }
}

fn message_of(transition: &Transition) -> v1::JobTransition {
    let named = |job: &String| v1::JobNamed { job: job.clone() };
    let change = match transition {
        Transition::Published(job) => Change::Published(v1::FarmJob {
            id: job.id.clone(),
            payload: job.payload.clone(),
            priority: job.priority,
            cores: job.needs.cores,
            memory_bytes: job.needs.memory_bytes,
            accelerators: job.needs.accelerators,
            attempts: job.retry.attempts,
            first_delay_s: job.retry.first_delay_s,
            longest_delay_s: job.retry.longest_delay_s,
            accelerator: job.accelerator.clone(),
        }),
        Transition::Claimed { job, worker, lease_s } => {
            Change::Claimed(v1::JobClaimed { job: job.clone(), worker: worker.clone(), lease_s: *lease_s })
        }
        Transition::Renewed { job, lease_s } => {
            Change::Renewed(v1::JobRenewed { job: job.clone(), lease_s: *lease_s })
        }
        Transition::Expired { job } => Change::Expired(named(job)),
        Transition::Completed { job, outcome } => {
            Change::Completed(v1::JobCompleted { job: job.clone(), outcome: outcome.clone() })
        }
        Transition::Failed { job, class, error } => Change::Failed(v1::JobFailed {
            job: job.clone(),
            class: class_message(*class).into(),
            error: error.clone(),
        }),
        Transition::Released { job, reason } => {
            Change::Released(v1::JobReleased { job: job.clone(), reason: reason.clone() })
        }
        Transition::Revived { job } => Change::Revived(named(job)),
        Transition::Withdrawn { job } => Change::Withdrawn(named(job)),
        Transition::Waited { job, reason } => {
            Change::Waited(v1::JobWaited { job: job.clone(), reason: reason.clone() })
        }
        Transition::Stored { job, checkpoint } => {
            Change::Stored(v1::JobStored { job: job.clone(), checkpoint: checkpoint.clone() })
        }
        Transition::Kept { job, worker, keep_s } => {
            Change::Kept(v1::JobKept { job: job.clone(), worker: worker.clone(), keep_s: *keep_s })
        }
        Transition::Announced { worker, whole, accelerator } => Change::Announced(v1::WorkerAnnounced {
            worker: worker.clone(),
            cores: whole.cores,
            memory_bytes: whole.memory_bytes,
            accelerators: whole.accelerators,
            accelerator: accelerator.clone(),
        }),
        Transition::ClockSet { seconds, since } => {
            Change::ClockSet(v1::ClockSet { seconds: *seconds, since: *since })
        }
        Transition::Paused { worker, reason } => {
            Change::Paused(v1::WorkerPaused { worker: worker.clone(), reason: reason.clone() })
        }
        Transition::TimesMoved { seconds, since } => {
            Change::TimesMoved(v1::TimesMoved { seconds: *seconds, since: *since })
        }
        Transition::RestEnded { job } => Change::RestEnded(named(job)),
    };
    v1::JobTransition { change: Some(change) }
}

fn transition_of(message: v1::JobTransition) -> Result<Transition, LogRecordError> {
    Ok(match message.change.ok_or(LogRecordError::Newer)? {
        Change::Published(job) => Transition::Published(Job {
            id: job.id,
            payload: job.payload,
            priority: job.priority,
            needs: Needs { cores: job.cores, memory_bytes: job.memory_bytes, accelerators: job.accelerators },
            retry: Retry {
                attempts: job.attempts.max(1),
                first_delay_s: finite(job.first_delay_s)?,
                longest_delay_s: finite(job.longest_delay_s)?,
            },
            accelerator: job.accelerator,
        }),
        Change::Claimed(m) => {
            Transition::Claimed { job: m.job, worker: m.worker, lease_s: finite(m.lease_s)? }
        }
        Change::Renewed(m) => Transition::Renewed { job: m.job, lease_s: finite(m.lease_s)? },
        Change::Expired(m) => Transition::Expired { job: m.job },
        Change::Completed(m) => Transition::Completed { job: m.job, outcome: m.outcome },
        Change::Failed(m) => {
            let class = class_of(m.class())?;
            Transition::Failed { job: m.job, class, error: m.error }
        }
        Change::Released(m) => Transition::Released { job: m.job, reason: m.reason },
        Change::Revived(m) => Transition::Revived { job: m.job },
        Change::Withdrawn(m) => Transition::Withdrawn { job: m.job },
        Change::Waited(m) => Transition::Waited { job: m.job, reason: m.reason },
        Change::Stored(m) => Transition::Stored { job: m.job, checkpoint: m.checkpoint },
        Change::Kept(m) => Transition::Kept { job: m.job, worker: m.worker, keep_s: finite(m.keep_s)? },
        Change::Announced(m) => Transition::Announced {
            worker: m.worker,
            whole: Needs { cores: m.cores, memory_bytes: m.memory_bytes, accelerators: m.accelerators },
            accelerator: m.accelerator,
        },
        Change::Paused(m) => Transition::Paused { worker: m.worker, reason: m.reason },
        Change::ClockSet(m) => {
            finite(m.seconds.abs())?;
            Transition::ClockSet { seconds: m.seconds, since: m.since }
        }
        Change::TimesMoved(m) => {
            finite(m.seconds.abs())?;
            Transition::TimesMoved { seconds: m.seconds, since: m.since }
        }
        Change::RestEnded(m) => Transition::RestEnded { job: m.job },
    })
}

/// A length of time, in seconds.
fn finite(seconds: f64) -> Result<f64, LogRecordError> {
    if seconds.is_finite() && seconds >= 0.0 { Ok(seconds) } else { Err(LogRecordError::Void) }
}

fn class_message(class: ErrorClass) -> v1::FailureClass {
    match class {
        ErrorClass::Retryable => v1::FailureClass::Retryable,
        ErrorClass::Fatal => v1::FailureClass::Fatal,
        ErrorClass::Shortage => v1::FailureClass::Shortage,
        // Being stopped is a release.
        ErrorClass::Stopped => v1::FailureClass::Unspecified,
    }
}

fn class_of(class: v1::FailureClass) -> Result<ErrorClass, LogRecordError> {
    match class {
        v1::FailureClass::Retryable => Ok(ErrorClass::Retryable),
        v1::FailureClass::Fatal => Ok(ErrorClass::Fatal),
        v1::FailureClass::Shortage => Ok(ErrorClass::Shortage),
        v1::FailureClass::Unspecified => Err(LogRecordError::Newer),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn every_transition() -> Vec<Transition> {
        let job = || "a".to_owned();
        let needs = Needs { cores: 2, memory_bytes: 3 << 30, accelerators: 1 };
        let retry = Retry { attempts: 4, first_delay_s: 1.5, longest_delay_s: 60.0 };
        vec![
            Transition::Published(Job {
                id: job(),
                payload: "p".into(),
                priority: -3,
                needs,
                retry,
                accelerator: Some("h100".into()),
            }),
            Transition::Claimed { job: job(), worker: "w".into(), lease_s: 60.0 },
            Transition::Renewed { job: job(), lease_s: 60.0 },
            Transition::Expired { job: job() },
            Transition::Completed { job: job(), outcome: "{}".into() },
            Transition::Failed { job: job(), class: ErrorClass::Retryable, error: "e".into() },
            Transition::Failed { job: job(), class: ErrorClass::Fatal, error: "e".into() },
            Transition::Failed { job: job(), class: ErrorClass::Shortage, error: "e".into() },
            Transition::Released { job: job(), reason: "r".into() },
            Transition::Revived { job: job() },
            Transition::Withdrawn { job: job() },
            Transition::Waited { job: job(), reason: Some("r".into()) },
            Transition::Waited { job: job(), reason: None },
            Transition::Stored { job: job(), checkpoint: "c".into() },
            Transition::Kept { job: job(), worker: "w".into(), keep_s: 300.0 },
            Transition::Announced { worker: "w".into(), whole: needs, accelerator: Some("h100".into()) },
            Transition::Announced { worker: "w".into(), whole: needs, accelerator: None },
            Transition::Paused { worker: "w".into(), reason: Some("r".into()) },
            Transition::Paused { worker: "w".into(), reason: None },
            Transition::ClockSet { seconds: -5.0, since: 7 },
            Transition::TimesMoved { seconds: 5.0, since: 7 },
            Transition::RestEnded { job: job() },
        ]
    }

    fn record() -> LogRecord {
        let [id, after, writer] = ["2", "1", "here"].map(str::to_owned);
        LogRecord { id, after, writer, transitions: every_transition() }
    }

    #[test]
    fn every_transition_comes_through_its_message() {
        let (id, found) = LogRecord::decode(&record().encode("f", None), "f", None);
        assert_eq!((id.as_str(), found), ("2", Ok(record())));
    }

    #[test]
    fn records_of_who_has_no_key_or_of_another_farm_are_void() {
        let key = FarmKey::of("secret\n");
        let signed = record().encode("f", Some(&key));
        let read = |bytes: &[u8], farm: &str, secret: &str| {
            LogRecord::decode(bytes, farm, Some(&FarmKey::of(secret))).1.map(|_| ())
        };
        assert_eq!(read(&signed, "f", "secret"), Ok(()));
        assert_eq!(read(&signed, "f", "another"), Err(LogRecordError::Void));
        assert_eq!(read(&signed, "g", "secret"), Err(LogRecordError::Void));
        let mark = |secret: &str, farm: &str| FarmKey::of(secret).mark(farm);
        assert_eq!(mark("secret", "f"), key.mark("f"));
        assert!(mark("another", "f") != key.mark("f") && key.mark("g") != key.mark("f"));
        assert!(LogRecord::is_signed(&signed) && !LogRecord::is_signed(&record().encode("f", None)));
        assert_eq!(read(&record().encode("f", None), "f", "secret"), Err(LogRecordError::Void));
        let mut changed = LogRecord { writer: "there".into(), ..record() }.encode("f", None);
        changed.extend_from_slice(&signed[signed.len() - 34..]);
        assert_eq!(
            read(&changed, "f", "secret"),
            Err(LogRecordError::Void),
            "the signature of another record"
        );
        assert!(!format!("{key:?}").contains("secret"));
    }

    #[test]
    fn records_of_a_newer_version_are_refused_and_nonsense_is_void() {
        let unknown = v1::FarmRecord {
            id: "3".into(),
            transitions: vec![v1::JobTransition { change: None }],
            ..v1::FarmRecord::default()
        };
        assert_eq!(LogRecord::decode(&unknown.encode_to_vec(), "f", None).1, Err(LogRecordError::Newer));
        assert_eq!(LogRecord::decode(b"not a record", "f", None).1, Err(LogRecordError::Void));
        let endless = Transition::Claimed { job: "a".into(), worker: "w".into(), lease_s: f64::NAN };
        let bytes = LogRecord { transitions: vec![endless], ..record() }.encode("f", None);
        assert_eq!(LogRecord::decode(&bytes, "f", None).1, Err(LogRecordError::Void));
    }
}
