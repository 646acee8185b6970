//! Single requests to the server: each ends in a time, and is repeated until the patience is over.

use std::time::{Duration, Instant};

use async_nats::jetstream::context::PublishErrorKind;
use async_nats::jetstream::stream::{RawMessageErrorKind, Stream};
use async_nats::jetstream::{self, object_store};
use async_nats::{HeaderMap, header};
use tokio::io::AsyncReadExt;

use super::error::{ClientError, FarmServerError};

/// A request that is not answered for so long is made again.
pub(super) const REQUEST_TIMEOUT: Duration = Duration::from_secs(5);
/// Pause before a request is repeated: at first, and at most.
const PAUSE: [Duration; 2] = [Duration::from_millis(50), Duration::from_secs(1)];
/// The largest snapshot that is read.
const MOST_SNAPSHOT: u64 = 256 << 20;

/// Why a request failed.
#[derive(Debug)]
pub(super) enum RequestError {
    /// It may be answered later.
    Passing(FarmServerError),
    /// It will not.
    Final(FarmServerError),
}

impl RequestError {
    /// What the client reports, and may not report again.
    pub fn passing(error: impl std::error::Error + Send + Sync + 'static) -> RequestError {
        RequestError::Passing(FarmServerError::client(error))
    }
}

/// A stored record.
#[derive(Debug)]
pub(super) struct StoredRecord {
    pub payload: Vec<u8>,
    /// When the server stored it, in seconds since 1970 by its clock.
    pub time: f64,
}

/// What became of an append.
#[derive(Debug)]
pub(super) enum Appended {
    /// It is in the log.
    Yes,
    /// Somebody else appended before.
    No,
    /// No answer came: it may be in the log, or come there yet.
    Unknown(ClientError),
}

/// The first and the last record that are there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LogExtent {
    pub first: u64,
    pub last: u64,
    pub count: u64,
}

#[derive(Clone)]
pub(super) struct LogServer {
    pub context: jetstream::Context,
    pub stream: Stream,
    pub subject: String,
    pub bucket: String,
    pub patience: Duration,
}

/// Repeats a request until it is answered, or the patience is over.
pub(super) async fn persist<T, F>(patience: Duration, request: impl Fn() -> F) -> Result<T, FarmServerError>
where
    F: Future<Output = Result<T, RequestError>>,
{
    let began = Instant::now();
    let mut pause = PAUSE[0];
    loop {
        let passed = match request().await {
            Ok(answer) => return Ok(answer),
            Err(RequestError::Final(reason)) => return Err(reason),
            Err(RequestError::Passing(reason)) => reason,
        };
        if began.elapsed() + pause > patience {
            let seconds = began.elapsed().as_secs_f64();
            return Err(FarmServerError::Silent { seconds, last: Box::new(passed) });
        }
        tokio::time::sleep(pause).await;
        pause = (2 * pause).min(PAUSE[1]);
    }
}

impl LogServer {
    /// A record; `None` where there is none.
    pub async fn record(self, sequence: u64) -> Result<Option<StoredRecord>, FarmServerError> {
        persist(self.patience, || async {
            match self.stream.get_raw_message(sequence).await {
                Ok(message) => Ok(Some(StoredRecord {
                    payload: message.payload.to_vec(),
                    time: message.time.unix_timestamp_nanos() as f64 * 1e-9,
                })),
                Err(error) => match error.kind() {
                    RawMessageErrorKind::NoMessageFound => Ok(None),
                    _ => Err(RequestError::passing(error)),
                },
            }
        })
        .await
    }

    /// What of the log is there.
    pub async fn extent(self) -> Result<LogExtent, FarmServerError> {
        persist(self.patience, || async {
            let info = self.stream.get_info().await.map_err(RequestError::passing)?;
            let state = info.state;
            Ok(LogExtent { first: state.first_sequence, last: state.last_sequence, count: state.messages })
        })
        .await
    }

    /// Appends a record if the last one is still number `last`.
    pub async fn append(self, id: String, bytes: Vec<u8>, last: u64) -> Result<Appended, FarmServerError> {
        let mut headers = HeaderMap::new();
        headers.insert(header::NATS_MESSAGE_ID, id.as_str());
        headers.insert(header::NATS_EXPECTED_LAST_SEQUENCE, last.to_string().as_str());
        let sent = self.context.publish_with_headers(self.subject.clone(), headers, bytes.into()).await;
        let answer = match sent {
            Ok(answer) => answer.await,
            Err(error) => Err(error),
        };
        match answer {
            Ok(_) => Ok(Appended::Yes),
            Err(error) => match error.kind() {
                PublishErrorKind::WrongLastSequence => Ok(Appended::No),
                PublishErrorKind::MaxPayloadExceeded => Err(FarmServerError::TooLarge(error.into())),
                _ => Ok(Appended::Unknown(error.into())),
            },
        }
    }

    /// A snapshot; `None` where there is none that is whole.
    pub async fn snapshot(self, covers: u64) -> Result<Option<Vec<u8>>, FarmServerError> {
        persist(self.patience, || async {
            let Ok(store) = self.context.get_object_store(&self.bucket).await else { return Ok(None) };
            let object = match store.get(name_of(covers)).await {
                Ok(object) => object,
                Err(error) if error.kind() == object_store::GetErrorKind::NotFound => return Ok(None),
                Err(error) => return Err(RequestError::passing(error)),
            };
            let mut bytes = Vec::new();
            let mut object = object.take(MOST_SNAPSHOT);
            match tokio::time::timeout(self.patience, object.read_to_end(&mut bytes)).await {
                Ok(Ok(_)) => Ok(Some(bytes)),
                // Its digest is wrong, or parts are missing.
                Ok(Err(_)) => Ok(None),
                Err(_) => Err(RequestError::Passing(FarmServerError::LateSnapshot)),
            }
        })
        .await
    }

    /// Stores a snapshot, reads it again, and lets the log forget what it covers but for the last record.
    pub async fn compact(self, covers: u64, bytes: Vec<u8>) -> Result<(), FarmServerError> {
        let before = self.clone().extent().await?;
        let config = object_store::Config {
            bucket: self.bucket.clone(),
            description: Some("snapshots of the log of a segwild farm".into()),
            ..object_store::Config::default()
        };
        let store = match self.context.get_object_store(&self.bucket).await {
            Ok(store) => store,
            Err(_) => self.context.create_object_store(config).await.map_err(FarmServerError::client)?,
        };
        let put = store.put(name_of(covers).as_str(), &mut bytes.as_slice()).await;
        put.map_err(FarmServerError::client)?;
        if self.clone().snapshot(covers).await? != Some(bytes) {
            return Err(FarmServerError::OtherSnapshot);
        }
        self.stream.purge().sequence(covers).await.map_err(FarmServerError::client)?;
        if before.first < covers {
            // The one that this one follows; it may not be there.
            let _ = store.delete(name_of(before.first)).await;
        }
        Ok(())
    }
}

fn name_of(covers: u64) -> String {
    format!("at-{covers}")
}
