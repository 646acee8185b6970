//! Artefacts in a bucket of JetStream: for small farms on one site, which then need no other store.

use std::io;
use std::ops::RangeInclusive;
use std::path::Path;
use std::pin::Pin;
use std::task::{Context as TaskContext, Poll, ready};
use std::time::Duration;

use async_nats::jetstream;
use async_nats::jetstream::context::PublishErrorKind;
use async_nats::jetstream::object_store::{
    Config, GetErrorKind, InfoErrorKind, ObjectInfo, ObjectMetadata, ObjectStore,
};
use async_nats::jetstream::stream::{LastRawMessageErrorKind, StorageType, Stream};
use async_nats::{HeaderMap, header};
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE;
use tokio::io::{AsyncRead, AsyncReadExt, ReadBuf};
use tokio::runtime::Handle;
use tokio::sync::mpsc;

use super::calls::StoreCalls;
use super::digest::ArtefactDigest;
use super::error::ArtefactError;
use super::store::{ArtefactStore, RENEWED_AFTER, StoredArtefact, seconds_now};
use super::transfer::{CallFailure, Outgoing, SILENCE, receive, show_listed};

/// Bytes of a message.
const PIECE: usize = 128 << 10;
/// Pieces that wait to be sent or written.
const AHEAD: usize = 16;
/// How the description of an object starts that was renewed: the time follows, in seconds since 1970. The object's own time
/// stays that at which its bytes came.
const RENEWED: &str = "renewed at ";
/// How often a description is written again that somebody else has written meanwhile.
const TRIES: usize = 8;

/// A store of artefacts in an object store bucket of JetStream.
pub struct JetStreamArtefacts {
    name: String,
    bucket: ObjectStore,
    messages: BucketMessages,
    /// What has been there for so long is renewed when it is stored again.
    renewed_after: Duration,
    calls: StoreCalls,
}

impl std::fmt::Debug for JetStreamArtefacts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("JetStreamArtefacts").field("name", &self.name).finish_non_exhaustive()
    }
}

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
            let bucket = match context.get_object_store(&wanted).await {
                Ok(bucket) => bucket,
                // It is not there, or the server cannot be reached: then making it fails, too.
                Err(_) => {
                    let bucket = wanted.clone();
                    let config = Config { bucket, storage: StorageType::File, ..Config::default() };
                    context.create_object_store(config).await?
                }
            };
            let stream = context.get_stream(format!("OBJ_{wanted}")).await?;
            Ok::<_, CallFailure>((bucket, BucketMessages { context, stream, bucket: wanted }))
        });
        let failed = |source: CallFailure| ArtefactError::Store {
            store: name.clone(),
            action: "open the bucket".into(),
            source,
        };
        let (bucket, messages) = opened.map_err(|e| failed(e.into()))?.map_err(failed)?;
        Ok(Self { name, bucket, messages, renewed_after: RENEWED_AFTER, calls })
    }

    /// The same store, which renews what is stored again once it has been there for so long (10 h otherwise).
    #[must_use]
    pub fn renewing_after(mut self, age: Duration) -> Self {
        self.renewed_after = age;
        self
    }

    /// Renews an artefact without its bytes; `false` where that fails, or it went meanwhile: one that was removed stays so.
    fn renew(&self, digest: &ArtefactDigest) -> bool {
        let (messages, name) = (self.messages.clone(), digest.to_string());
        let renewed = self.calls.wait(async move {
            for _ in 0..TRIES {
                let Some((mut info, last)) = messages.described(&name).await? else { return Ok(false) };
                if info.deleted {
                    return Ok(false);
                }
                info.description = Some(format!("{RENEWED}{}", seconds_now()));
                if messages.describe(&info, last).await? {
                    return Ok(true);
                }
            }
            Ok::<_, CallFailure>(false)
        });
        matches!(renewed, Ok(Ok(true)))
    }

    fn failed(&self, action: &str, digest: &ArtefactDigest) -> impl Fn(CallFailure) -> ArtefactError + use<> {
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
        let open = async move { bucket.list().await.map_err(CallFailure::from) };
        show_listed(&self.calls, &self.name, open, &mut |info: ObjectInfo| {
            if let Some(artefact) = listed(&info) {
                show(artefact);
            }
        })
    }

    fn remove_older(&self, digest: &ArtefactDigest, least: Duration) -> Result<bool, ArtefactError> {
        let (messages, name) = (self.messages.clone(), digest.to_string());
        let failed = self.failed("remove", digest);
        let removed = self.calls.wait(async move {
            for _ in 0..TRIES {
                let Some((mut info, last)) = messages.described(&name).await? else { return Ok(false) };
                if !listed(&info).is_some_and(|there| there.is_older(least)) {
                    return Ok(false);
                }
                (info.chunks, info.size, info.deleted) = (0, 0, true);
                // Who has renewed it since has described it otherwise.
                if messages.describe(&info, last).await? {
                    messages.remove_pieces(&info).await?;
                    return Ok(true);
                }
            }
            Ok::<_, CallFailure>(false)
        });
        removed.map_err(|e| failed(e.into()))?.map_err(failed)
    }

    fn put(&self, digest: &ArtefactDigest, file: &Path) -> Result<(), ArtefactError> {
        if self.find(digest)?.is_some_and(|there| !there.is_older(self.renewed_after) || self.renew(digest)) {
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

    fn get(
        &self,
        digest: &ArtefactDigest,
        bytes: RangeInclusive<u64>,
        to: &Path,
    ) -> Result<(), ArtefactError> {
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
                    Ok(read) => read.map_err(CallFailure::from),
                    Err(elapsed) => Err(CallFailure::from(elapsed)),
                };
                let ends = read.as_ref().map_or(true, |n| *n == 0);
                let piece = read.map(|_| piece).map_err(&failed);
                if send.send(piece).await.is_err() || ends {
                    break;
                }
            }
        });
        receive(&self.name, digest, &bytes, to, || pieces.blocking_recv())
    }
}

/// What the bucket's client has no call for: who describes an object names the description that was there before. So of two who
/// do that at once, one sees that the other was first.
#[derive(Clone)]
struct BucketMessages {
    context: jetstream::Context,
    stream: Stream,
    bucket: String,
}

impl BucketMessages {
    /// An object as it is described, and the number of the message that does so; `None` where none ever was.
    async fn described(&self, object: &str) -> Result<Option<(ObjectInfo, u64)>, CallFailure> {
        match self.stream.get_last_raw_message_by_subject(&self.subject(object)).await {
            Ok(message) => Ok(Some((serde_json::from_slice(&message.payload)?, message.sequence))),
            Err(error) if matches!(error.kind(), LastRawMessageErrorKind::NoMessageFound) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Describes an object; `false` where message `last` is not its description any more.
    async fn describe(&self, info: &ObjectInfo, last: u64) -> Result<bool, CallFailure> {
        let mut headers = HeaderMap::new();
        // It replaces the description before it.
        headers.insert(header::NATS_ROLLUP, "sub");
        headers.insert(header::NATS_EXPECTED_LAST_SUBJECT_SEQUENCE, last.to_string());
        let message = serde_json::to_vec(info)?;
        let sent = self.context.publish_with_headers(self.subject(&info.name), headers, message.into()).await;
        let answer = match sent {
            Ok(answer) => answer.await,
            Err(error) => Err(error),
        };
        match answer {
            Ok(_) => Ok(true),
            Err(error) if matches!(error.kind(), PublishErrorKind::WrongLastSequence) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes the bytes of an object.
    async fn remove_pieces(&self, info: &ObjectInfo) -> Result<(), CallFailure> {
        self.stream.purge().filter(format!("$O.{}.C.{}", self.bucket, info.nuid)).await?;
        Ok(())
    }

    fn subject(&self, object: &str) -> String {
        format!("$O.{}.M.{}", self.bucket, base64_of(object))
    }
}

/// A name as it stands in the subject of its description: in the base64 of RFC 4648, section 5, as NATS' clients agree on.
fn base64_of(name: &str) -> String {
    URL_SAFE.encode(name)
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

#[cfg(test)]
mod tests {
    use super::base64_of;

    #[test]
    fn names_have_the_base64_of_the_standard() {
        // RFC 4648, section 10, and a sign of section 5 alone.
        for (name, text) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
            ("??>", "Pz8-"),
        ] {
            assert_eq!(base64_of(name), text, "{name}");
        }
    }
}
