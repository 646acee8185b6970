//! Files piece by piece, hashed on the way; and lists, entry by entry.

use std::fs::File;
use std::io::{Read, Write};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use futures_util::{Stream, StreamExt};
use segwild_flow::FileError;
use segwild_flow::files::{open_plain, write_with};
use tokio::sync::mpsc;

use super::calls::StoreCalls;
use super::digest::ArtefactDigest;
use super::error::ArtefactError;

/// A store that delivers nothing for so long is given up.
pub(super) const SILENCE: Duration = Duration::from_secs(60);
/// Entries that are listed before they are shown.
const LISTED_AHEAD: usize = 1024;

/// Why a call of a store's client has no result.
pub(super) type CallFailure = Box<dyn std::error::Error + Send + Sync>;

/// A file that is sent.
pub(super) struct Outgoing {
    path: PathBuf,
    file: File,
    digest: ArtefactDigest,
    hasher: blake3::Hasher,
}

impl Outgoing {
    pub fn open(digest: &ArtefactDigest, path: &Path) -> Result<Self, ArtefactError> {
        let file = open_plain(path).map_err(|e| FileError::new("read", path, e))?;
        Ok(Self { path: path.to_owned(), file, digest: *digest, hasher: blake3::Hasher::new() })
    }

    /// Its length in bytes, as it is now.
    pub fn length(&self) -> Result<u64, ArtefactError> {
        Ok(self.file.metadata().map_err(|e| FileError::new("read", &self.path, e))?.len())
    }

    /// The next piece; one that is shorter than `most` bytes is the last.
    pub fn piece(&mut self, most: usize) -> Result<Vec<u8>, ArtefactError> {
        let mut piece = Vec::new();
        let read = (&mut self.file).take(most as u64).read_to_end(&mut piece);
        read.map_err(|e| FileError::new("read", &self.path, e))?;
        self.hasher.update(&piece);
        Ok(piece)
    }

    /// Whether all that was read is the artefact.
    pub fn check(&self) -> Result<(), ArtefactError> {
        if ArtefactDigest::finish(&self.hasher) == self.digest {
            return Ok(());
        }
        Err(ArtefactError::Changed { path: self.path.clone(), digest: self.digest })
    }
}

/// Writes the pieces of an artefact into a file, which appears only if they are the artefact and have so many bytes. What goes
/// beyond the most is not written: a store that delivers without end fills no disk.
pub(super) fn receive<P: AsRef<[u8]>>(
    store: &str,
    digest: &ArtefactDigest,
    bytes: &RangeInclusive<u64>,
    to: &Path,
    mut next: impl FnMut() -> Option<Result<P, ArtefactError>>,
) -> Result<(), ArtefactError> {
    write_with(to, |file| {
        let (mut hasher, mut received) = (blake3::Hasher::new(), 0u64);
        let (least, most) = (*bytes.start(), *bytes.end());
        while let Some(piece) = next() {
            let piece = piece?;
            received = received.saturating_add(piece.as_ref().len() as u64);
            if received > most {
                return Err(ArtefactError::Long { store: store.to_owned(), digest: *digest, most });
            }
            hasher.update(piece.as_ref());
            file.write_all(piece.as_ref()).map_err(|e| FileError::new("write", to, e))?;
        }
        let found = ArtefactDigest::finish(&hasher);
        if found != *digest {
            return Err(ArtefactError::Damaged { store: store.to_owned(), digest: *digest, found });
        }
        if received < least {
            return Err(ArtefactError::Short { store: store.to_owned(), digest: *digest, received, least });
        }
        Ok(())
    })
}

/// Shows the entries of a list that a client delivers, in this thread.
pub(super) fn show_listed<S, T, E>(
    calls: &StoreCalls,
    store: &str,
    open: impl Future<Output = Result<S, CallFailure>> + Send + 'static,
    show: &mut dyn FnMut(T),
) -> Result<(), ArtefactError>
where
    S: Stream<Item = Result<T, E>> + Unpin + Send + 'static,
    T: Send + 'static,
    E: Into<CallFailure> + Send + 'static,
{
    let (send, mut found) = mpsc::channel::<Result<T, CallFailure>>(LISTED_AHEAD);
    // Ends when all is listed, or nobody takes more.
    let _under_way = calls.start(async move {
        let mut list = match open.await {
            Ok(list) => list,
            // Where nobody listens, nobody wants to know.
            Err(error) => return drop(send.send(Err(error)).await),
        };
        loop {
            let next: Result<T, CallFailure> = match tokio::time::timeout(SILENCE, list.next()).await {
                Ok(Some(next)) => next.map_err(Into::into),
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
        show(next.map_err(|source| ArtefactError::Store {
            store: store.to_owned(),
            action: "list the artefacts".into(),
            source,
        })?);
    }
    Ok(())
}
