//! Why a farm's server does not serve.

use std::error::Error;
use std::path::PathBuf;

use super::record::LogRecordError;

/// What the client of a server reports.
pub(super) type ClientError = Box<dyn Error + Send + Sync>;

/// Why a farm's server does not serve.
#[derive(Debug, thiserror::Error)]
pub(super) enum FarmServerError {
    /// Its client or the system reports this.
    #[error("{0}")]
    Client(#[source] ClientError),
    /// It has not answered within the patience.
    #[error("no answer for {seconds:.0} s: {last}")]
    Silent {
        seconds: f64,
        /// What the last attempt ended with.
        #[source]
        last: Box<FarmServerError>,
    },
    /// Who connects may not.
    #[error("it refuses who connects: {0}")]
    Refused(#[source] ClientError),
    /// The file with the credentials cannot be used.
    #[error("cannot read the credentials {}: {source}", file.display())]
    Credentials { file: PathBuf, source: std::io::Error },
    /// The file with the certificates cannot be read.
    #[error("cannot read the certificates {}: {source}", file.display())]
    Certificates { file: PathBuf, source: std::io::Error },
    /// Its certificate is by nobody who is trusted, is for another name, or is not valid now.
    #[error("its certificate is not trusted: {0}; --certificates names who signed it")]
    Untrusted(#[source] ClientError),
    /// It keeps no logs.
    #[error("it runs without JetStream; start it with -js")]
    NoJetStream,
    /// A stream of the farm's name is something else.
    #[error("its stream {stream} is no log of a farm: it does not hold {subject}")]
    NoLog { stream: String, subject: String },
    /// A record is too large for it.
    #[error("{0}; a job is too large for the server's `max_payload`")]
    TooLarge(#[source] ClientError),
    /// A record may be in the log or not, and does not get there.
    #[error("a record could not be appended: {0}")]
    NotAppended(#[source] ClientError),
    /// A newer version of the program wrote a record.
    #[error("record {record}: {reason}")]
    Record {
        record: u64,
        #[source]
        reason: LogRecordError,
    },
    /// A record is not in the log any more.
    #[error("record {0} of the log is missing: somebody removed it")]
    NoRecord(u64),
    /// What the log starts at is not there.
    #[error("the log starts at record {0}, and the snapshot of what was before is missing")]
    NoSnapshot(u64),
    /// A snapshot does not come.
    #[error("a snapshot does not arrive")]
    LateSnapshot,
    /// A snapshot comes back with other bytes.
    #[error("a snapshot is read otherwise than it was written")]
    OtherSnapshot,
    /// A snapshot is no table.
    #[error("the snapshot at record {covers} cannot be read: {source}")]
    Snapshot { covers: u64, source: serde_json::Error },
    /// A snapshot is of another version of the program.
    #[error("the snapshot at record {covers} has format {found}, this program knows format {known}")]
    SnapshotFormat { covers: u64, found: u32, known: u32 },
    /// The system gives no random number for a record's name.
    #[error("no random number: {0}")]
    NoRandom(#[source] getrandom::Error),
    /// Its client has ended.
    #[error("the client has ended")]
    Ended,
    /// The engine has ended.
    #[error("it is closed")]
    Closed,
}

impl FarmServerError {
    /// For `map_err`: what the client or the system reports.
    pub fn client(error: impl Error + Send + Sync + 'static) -> FarmServerError {
        FarmServerError::Client(Box::new(error))
    }
}
