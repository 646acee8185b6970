//! Artefacts in a bucket of JetStream: for small farms on one site, which then need no other store.

use std::io;
use std::path::Path;
use std::pin::Pin;
use std::task::{Context as TaskContext, Poll, ready};
use std::time::Duration;

use async_nats::jetstream::object_store::{
    Config, DeleteErrorKind, GetErrorKind, InfoErrorKind, ObjectInfo, ObjectMetadata, ObjectStore,
    UpdateMetadata,
};
use async_nats::jetstream::{self, stream::StorageType};
use futures_util::StreamExt;
use tokio::io::{AsyncRead, AsyncReadExt, ReadBuf};
use tokio::runtime::Handle;
use tokio::sync::mpsc;

use super::calls::StoreCalls;
use super::digest::ArtefactDigest;
use super::error::ArtefactError;
use super::store::{ArtefactStore, StoredArtefact, seconds_now};
use super::transfer::{Outgoing, receive};

/// Bytes of a message.
const PIECE: usize = 128 << 10;
/// Pieces that wait to be sent or written.
const AHEAD: usize = 16;
/// Artefacts that are listed before they are looked at.
const LISTED_AHEAD: usize = 1024;
/// A server that delivers nothing for so long is given up.
const SILENCE: Duration = Duration::from_secs(60);
/// How the description of an object starts that was renewed: the time follows, in seconds since 1970. The client keeps the
/// object's own time when it changes a description.
const RENEWED: &str = "renewed at ";

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

    /// Renews an artefact without its bytes; `false` where that fails, or it went meanwhile.
    fn renew(&self, digest: &ArtefactDigest) -> bool {
        let (bucket, name) = (self.bucket.clone(), digest.to_string());
        let description = Some(format!("{RENEWED}{}", seconds_now()));
        let renewed = self.calls.wait(async move {
            let key = name.clone();
            bucket
                .update_metadata(key, UpdateMetadata { name, description, ..UpdateMetadata::default() })
                .await
        });
        matches!(renewed, Ok(Ok(info)) if !info.deleted)
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

    fn find(&self, digest: &ArtefactDigest) -> Result<Option<StoredArtefact>, ArtefactError> {
        let (bucket, key) = (self.bucket.clone(), digest.to_string());
        let failed = self.failed("find", digest);
        let found = self.calls.wait(async move { bucket.info(key).await });
        match found.map_err(|e| failed(e.into()))? {
            Ok(info) => Ok(listed(&info)),
            Err(error) if error.kind() == InfoErrorKind::NotFound => Ok(None),
            Err(error) => Err(failed(error.into())),
        }
    }

    fn list(&self, show: &mut dyn FnMut(StoredArtefact)) -> Result<(), ArtefactError> {
        let bucket = self.bucket.clone();
        let (send, mut found) = mpsc::channel::<Result<ObjectInfo, Failure>>(LISTED_AHEAD);
        // Ends when all is listed, or nobody takes more.
        let _under_way = self.calls.start(async move {
            let mut list = match bucket.list().await {
                Ok(list) => list,
                // Where nobody listens, nobody wants to know.
                Err(error) => return drop(send.send(Err(error.into())).await),
            };
            loop {
                let next = match tokio::time::timeout(SILENCE, list.next()).await {
                    Ok(Some(next)) => next.map_err(Failure::from),
                    Ok(None) => break,
                    Err(elapsed) => Err(elapsed.into()),
                };
                let ends = next.is_err();
                if send.send(next).await.is_err() || ends {
                    break;
                }
            }
        });
        while let Some(next) = found.blocking_recv() {
            let info = next.map_err(|source| ArtefactError::Store {
                store: self.name.clone(),
                action: "list the artefacts".into(),
                source,
            })?;
            if let Some(artefact) = listed(&info) {
                show(artefact);
            }
        }
        Ok(())
    }

    fn remove(&self, digest: &ArtefactDigest) -> Result<(), ArtefactError> {
        let (bucket, key) = (self.bucket.clone(), digest.to_string());
        let failed = self.failed("remove", digest);
        let removed = self.calls.wait(async move { bucket.delete(key).await });
        match removed.map_err(|e| failed(e.into()))? {
            Ok(()) => Ok(()),
            Err(error) if matches!(error.kind(), DeleteErrorKind::NotFound) => Ok(()),
            Err(error) => Err(failed(error.into())),
        }
    }

    fn put(&self, digest: &ArtefactDigest, file: &Path) -> Result<(), ArtefactError> {
        if self.find(digest)?.is_some_and(|there| !there.is_old() || self.renew(digest)) {
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

/// An object as an artefact; `None` for what is none of ours, or was removed.
fn listed(info: &ObjectInfo) -> Option<StoredArtefact> {
    let digest = info.name.parse().ok().filter(|_| !info.deleted)?;
    let stored = info.modified.and_then(|time| u64::try_from(time.unix_timestamp()).ok());
    let renewed = info.description.as_deref().and_then(|text| text.strip_prefix(RENEWED)?.parse().ok());
    Some(StoredArtefact { digest, bytes: info.size as u64, since: stored.max(renewed).unwrap_or_default() })
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
