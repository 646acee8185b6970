//! Artefacts in a bucket of JetStream: for small farms on one site, which then need no other store.

use std::io;
use std::path::Path;
use std::pin::Pin;
use std::task::{Context as TaskContext, Poll, ready};
use std::time::Duration;

use async_nats::jetstream::object_store::{Config, GetErrorKind, InfoErrorKind, ObjectMetadata, ObjectStore};
use async_nats::jetstream::{self, stream::StorageType};
use tokio::io::{AsyncRead, AsyncReadExt, ReadBuf};
use tokio::runtime::Handle;
use tokio::sync::mpsc;

use super::calls::StoreCalls;
use super::digest::ArtefactDigest;
use super::error::ArtefactError;
use super::store::ArtefactStore;
use super::transfer::{Outgoing, receive};

/// Bytes of a message.
const PIECE: usize = 128 << 10;
/// Pieces that wait to be sent or written.
const AHEAD: usize = 16;
/// A server that delivers nothing for so long is given up.
const SILENCE: Duration = Duration::from_secs(60);

/// A store of artefacts in an object store bucket of JetStream.
pub struct JetStreamArtefacts {
    name: String,
    bucket: ObjectStore,
    calls: StoreCalls,
}

impl std::fmt::Debug for JetStreamArtefacts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("JetStreamArtefacts").field("name", &self.name).finish_non_exhaustive()
    }
}

/// Why a call has no result.
type Failure = Box<dyn std::error::Error + Send + Sync>;

impl JetStreamArtefacts {
    /// The bucket of a name, made if it is not there. `runtime` is the one on which the client of `context` runs.
    ///
    /// # Errors
    /// When the server cannot be reached or refuses the bucket.
    pub fn open(context: jetstream::Context, bucket: &str, runtime: Handle) -> Result<Self, ArtefactError> {
        let calls = StoreCalls::on(runtime);
        let name = format!("the bucket {bucket} of JetStream");
        let wanted = bucket.to_owned();
        let opened = calls.wait(async move {
            match context.get_object_store(&wanted).await {
                Ok(bucket) => Ok(bucket),
                // It is not there, or the server cannot be reached: then making it fails, too.
                Err(_) => {
                    let config = Config { bucket: wanted, storage: StorageType::File, ..Config::default() };
                    context.create_object_store(config).await
                }
            }
        });
        let failed = |source: Failure| ArtefactError::Store {
            store: name.clone(),
            action: "open the bucket".into(),
            source,
        };
        let bucket = opened.map_err(|e| failed(e.into()))?.map_err(|e| failed(e.into()))?;
        Ok(Self { name, bucket, calls })
    }

    fn failed(&self, action: &str, digest: &ArtefactDigest) -> impl Fn(Failure) -> ArtefactError + use<> {
        let (store, action) = (self.name.clone(), format!("{action} the artefact {digest}"));
        move |source| ArtefactError::Store { store: store.clone(), action: action.clone(), source }
    }
}

impl ArtefactStore for JetStreamArtefacts {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn has(&self, digest: &ArtefactDigest) -> Result<bool, ArtefactError> {
        let (bucket, key) = (self.bucket.clone(), digest.to_string());
        let failed = self.failed("find", digest);
        let found = self.calls.wait(async move { bucket.info(key).await });
        match found.map_err(|e| failed(e.into()))? {
            Ok(info) => Ok(!info.deleted),
            Err(error) if error.kind() == InfoErrorKind::NotFound => Ok(false),
            Err(error) => Err(failed(error.into())),
        }
    }

    fn put(&self, digest: &ArtefactDigest, file: &Path) -> Result<(), ArtefactError> {
        if self.has(digest)? {
            return Ok(());
        }
        let failed = self.failed("store", digest);
        let mut file = Outgoing::open(digest, file)?;
        let (send, pieces) = mpsc::channel(AHEAD);
        let (bucket, name) = (self.bucket.clone(), digest.to_string());
        let put = self.calls.start(async move {
            let meta = ObjectMetadata { name, chunk_size: Some(PIECE), ..ObjectMetadata::default() };
            bucket.put(meta, &mut Pieces { pieces, current: Vec::new(), read: 0 }).await
        });
        let mut refused = None;
        loop {
            match checked_piece(&mut file) {
                Ok(piece) => {
                    let last = piece.len() < PIECE;
                    // Where it takes no more, the client reports why.
                    if send.blocking_send(Ok(piece)).is_err() || last {
                        break;
                    }
                }
                Err(error) => {
                    let _ = send.blocking_send(Err(BrokenOff));
                    refused = Some(error);
                    break;
                }
            }
        }
        drop(send);
        let done = put.wait().map_err(|e| failed(e.into()))?;
        match refused {
            Some(error) => Err(error),
            None => done.map(|_| ()).map_err(|e| failed(e.into())),
        }
    }

    fn get(&self, digest: &ArtefactDigest, to: &Path) -> Result<(), ArtefactError> {
        let (bucket, key) = (self.bucket.clone(), digest.to_string());
        let failed = self.failed("fetch", digest);
        let found = self.calls.wait(async move { bucket.get(key).await });
        let mut object = match found.map_err(|e| failed(e.into()))? {
            Ok(object) => object,
            Err(error) if error.kind() == GetErrorKind::NotFound => {
                return Err(ArtefactError::Missing { store: self.name.clone(), digest: *digest });
            }
            Err(error) => return Err(failed(error.into())),
        };
        let (send, mut pieces) = mpsc::channel(AHEAD);
        // Ends when the object is whole, or nobody takes a piece any more.
        let _under_way = self.calls.start(async move {
            loop {
                let mut piece = Vec::with_capacity(PIECE);
                let read = match tokio::time::timeout(SILENCE, object.read_buf(&mut piece)).await {
                    Ok(read) => read.map_err(Failure::from),
                    Err(elapsed) => Err(elapsed.into()),
                };
                let ends = read.as_ref().map_or(true, |n| *n == 0);
                let piece = read.map(|_| piece).map_err(&failed);
                if send.send(piece).await.is_err() || ends {
                    break;
                }
            }
        });
        receive(&self.name, digest, to, || pieces.blocking_recv())
    }
}

/// The next piece of a file; the last one only if the whole is the artefact.
fn checked_piece(file: &mut Outgoing) -> Result<Vec<u8>, ArtefactError> {
    let piece = file.piece(PIECE)?;
    if piece.len() < PIECE {
        file.check()?;
    }
    Ok(piece)
}

/// A file cannot be read to its end. Who reads it reports why; to the client it is the sign to store nothing.
#[derive(Debug, thiserror::Error)]
#[error("the file cannot be read to its end")]
struct BrokenOff;

/// Pieces from another thread, as a reader.
struct Pieces {
    pieces: mpsc::Receiver<Result<Vec<u8>, BrokenOff>>,
    current: Vec<u8>,
    read: usize,
}

impl AsyncRead for Pieces {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut TaskContext<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        while self.read == self.current.len() {
            match ready!(self.pieces.poll_recv(context)) {
                Some(Ok(piece)) => (self.current, self.read) = (piece, 0),
                Some(Err(error)) => return Poll::Ready(Err(io::Error::other(error))),
                None => return Poll::Ready(Ok(())),
            }
        }
        let end = self.current.len().min(self.read + buffer.remaining());
        buffer.put_slice(&self.current[self.read..end]);
        self.read = end;
        Poll::Ready(Ok(()))
    }
}
