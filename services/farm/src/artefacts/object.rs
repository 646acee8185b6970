//! Artefacts in a shared folder or on S3.

use std::ops::RangeInclusive;
use std::path::{Path as FilePath, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use futures_util::StreamExt;
use object_store::aws::AmazonS3Builder;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{MultipartUpload, ObjectMeta, ObjectStore, ObjectStoreExt, PutMode, PutPayload};

use super::calls::StoreCalls;
use super::digest::ArtefactDigest;
use super::error::{ArtefactError, StoreAddressError};
use super::folder;
use super::http::HyperConnector;
use super::store::{ArtefactStore, RENEWED_AFTER, StoredArtefact};
use super::transfer::{Outgoing, SILENCE, receive, show_listed};
use crate::pending::ShutDown;

/// Bytes of a part; two are in memory at once. S3 takes no less than 5 MiB.
const PART: usize = 6 << 20;
/// S3 takes at most 10,000 parts.
const PARTS: u64 = 9000;
/// Pieces that are received before they are written.
const AHEAD: usize = 8;
/// The environment's names of an endpoint, as S3's clients know them; the first that is set holds.
const ENDPOINTS: [&str; 3] = ["AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"];

/// A store of artefacts in a folder that all machines mount, or in a bucket of S3.
///
/// ```text
/// PREFIX/ab/abcdef..   an artefact by its digest
/// ```
#[derive(Debug)]
pub struct ObjectArtefacts {
    name: String,
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    /// The shared folder, where it is one.
    folder: Option<PathBuf>,
    /// What has been there for so long is renewed when it is stored again.
    renewed_after: Duration,
    calls: StoreCalls,
}

impl ObjectArtefacts {
    /// The store at an address: a folder, `file:///FOLDER` or `s3://BUCKET/PREFIX`. The endpoint, the region and the
    /// credentials of S3 come from the environment (`AWS_ENDPOINT_URL`, `AWS_REGION`, `AWS_ACCESS_KEY_ID`, ..) and from
    /// nowhere else.
    ///
    /// # Errors
    /// When the address or the environment makes no sense, or the folder cannot be made.
    pub fn open(address: &str) -> Result<Self, ArtefactError> {
        let wrong = |reason| ArtefactError::Address { address: address.to_owned(), reason };
        let (store, prefix, folder): (Arc<dyn ObjectStore>, Path, Option<PathBuf>) = match address
            .split_once("://")
        {
            Some(("s3", rest)) => {
                let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
                if bucket.is_empty() || bucket.contains(['@', '?', '#']) {
                    return Err(wrong(StoreAddressError::NoBucket));
                }
                let prefix = Path::parse(prefix).map_err(|e| wrong(StoreAddressError::Client(e.into())))?;
                let bucket = bucket_of(bucket).map_err(|e| wrong(StoreAddressError::Client(e.into())))?;
                (Arc::new(bucket), prefix, None)
            }
            Some(("file", folder)) if folder.starts_with('/') => {
                (folder_at(folder, &wrong)?, Path::default(), Some(folder.into()))
            }
            Some(_) => return Err(wrong(StoreAddressError::OtherKind)),
            None if address.is_empty() => return Err(wrong(StoreAddressError::Empty)),
            None => (folder_at(address, &wrong)?, Path::default(), Some(address.into())),
        };
        let calls = StoreCalls::own().map_err(|e| wrong(StoreAddressError::Thread(e)))?;
        Ok(Self { name: address.to_owned(), store, prefix, folder, renewed_after: RENEWED_AFTER, calls })
    }

    /// The same store, which renews what is stored again once it has been there for so long (10 h otherwise).
    #[must_use]
    pub fn renewing_after(mut self, age: Duration) -> Self {
        self.renewed_after = age;
        self
    }

    fn key(&self, digest: &ArtefactDigest) -> Path {
        let hex = digest.to_string();
        self.prefix.clone().join(&hex[..2]).join(hex.as_str())
    }

    fn failed<E: std::error::Error + Send + Sync + 'static>(
        &self,
        action: &str,
        digest: &ArtefactDigest,
    ) -> impl Fn(E) -> ArtefactError + use<E> {
        let (store, action) = (self.name.clone(), format!("{action} the artefact {digest}"));
        move |error| ArtefactError::Store {
            store: store.clone(),
            action: action.clone(),
            source: Box::new(error),
        }
    }

    /// An artefact as it is listed; `None` for what is none of ours.
    fn listed(&self, meta: &ObjectMeta) -> Option<StoredArtefact> {
        let digest: ArtefactDigest = meta.location.filename()?.parse().ok()?;
        let since: u64 = meta.last_modified.timestamp().try_into().unwrap_or_default();
        (self.key(&digest) == meta.location).then_some(StoredArtefact { digest, bytes: meta.size, since })
    }

    /// Renews an artefact without its bytes; whether that was possible. S3 has no such call: there it is stored again.
    fn touch(&self, digest: &ArtefactDigest) -> bool {
        self.folder.as_ref().is_some_and(|folder| folder::touch(folder, digest))
    }

    /// Stores the bytes of a file; with `PutMode::Create`, a small one only if it is not there.
    fn store_bytes(
        &self,
        digest: &ArtefactDigest,
        file: &FilePath,
        mode: PutMode,
    ) -> Result<(), ArtefactError> {
        let mut file = Outgoing::open(digest, file)?;
        let part = PART.max(usize::try_from(file.length()? / PARTS).unwrap_or(usize::MAX));
        let first = file.piece(part)?;
        if first.len() < part {
            file.check()?;
            return self.put_small(digest, first, mode);
        }
        self.put_large(digest, file, first, part)
    }

    /// In one piece; with `PutMode::Create`, only if it is not there.
    fn put_small(&self, digest: &ArtefactDigest, bytes: Vec<u8>, mode: PutMode) -> Result<(), ArtefactError> {
        let (store, key) = (self.store.clone(), self.key(digest));
        let put =
            self.calls.wait(async move { store.put_opts(&key, PutPayload::from(bytes), mode.into()).await });
        match put.map_err(self.failed::<ShutDown>("store", digest))? {
            Ok(_) | Err(object_store::Error::AlreadyExists { .. }) => Ok(()),
            Err(error) => Err(self.failed("store", digest)(error)),
        }
    }

    /// In parts: the next one is read while one is sent. Nothing appears before the last one has come.
    fn put_large(
        &self,
        digest: &ArtefactDigest,
        mut file: Outgoing,
        first: Vec<u8>,
        part: usize,
    ) -> Result<(), ArtefactError> {
        let (store, key) = (self.store.clone(), self.key(digest));
        let upload = self.calls.wait(async move { store.put_multipart(&key).await });
        let upload = upload.map_err(self.failed::<ShutDown>("store", digest))?;
        let mut upload = upload.map_err(self.failed::<object_store::Error>("store", digest))?;
        match self.send_parts(digest, &mut file, first, part, upload.as_mut()) {
            Ok(()) => {
                let done = self.calls.wait(async move { upload.complete().await });
                let done = done.map_err(self.failed::<ShutDown>("store", digest))?;
                done.map(|_| ()).map_err(self.failed::<object_store::Error>("store", digest))
            }
            Err(error) => {
                // The error that matters is the first one.
                let _ = self.calls.wait(async move { upload.abort().await });
                Err(error)
            }
        }
    }

    fn send_parts(
        &self,
        digest: &ArtefactDigest,
        file: &mut Outgoing,
        first: Vec<u8>,
        part: usize,
        upload: &mut dyn MultipartUpload,
    ) -> Result<(), ArtefactError> {
        let mut next = first;
        loop {
            let last = next.len() < part;
            let sent = (!next.is_empty()).then(|| self.calls.start(upload.put_part(PutPayload::from(next))));
            next = if last { Vec::new() } else { file.piece(part)? };
            if let Some(sent) = sent {
                let sent = sent.wait().map_err(self.failed::<ShutDown>("store", digest))?;
                sent.map_err(self.failed::<object_store::Error>("store", digest))?;
            }
            if last {
                return file.check();
            }
        }
    }
}

fn folder_at(
    folder: &str,
    wrong: &impl Fn(StoreAddressError) -> ArtefactError,
) -> Result<Arc<dyn ObjectStore>, ArtefactError> {
    let made = std::fs::create_dir_all(FilePath::new(folder));
    made.map_err(|e| wrong(StoreAddressError::Folder(e)))?;
    let store = LocalFileSystem::new_with_prefix(folder);
    let store = store.map_err(|e| wrong(StoreAddressError::Client(e.into())))?;
    Ok(Arc::new(store.with_fsync(true)))
}

fn bucket_of(bucket: &str) -> object_store::Result<object_store::aws::AmazonS3> {
    let endpoint = ENDPOINTS.iter().find_map(|name| std::env::var(name).ok().filter(|url| !url.is_empty()));
    let plain = endpoint.as_ref().is_some_and(|url| url.starts_with("http://"));
    let mut builder = AmazonS3Builder::from_env()
        .with_bucket_name(bucket)
        .with_allow_http(plain)
        .with_http_connector(HyperConnector { plain });
    if let Some(endpoint) = endpoint {
        builder = builder.with_endpoint(endpoint.trim_end_matches('/'));
    }
    builder.build()
}

impl ArtefactStore for ObjectArtefacts {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn find(&self, digest: &ArtefactDigest) -> Result<Option<StoredArtefact>, ArtefactError> {
        let (store, key) = (self.store.clone(), self.key(digest));
        let found = self.calls.wait(async move { store.head(&key).await });
        match found.map_err(self.failed::<ShutDown>("find", digest))? {
            Ok(meta) => Ok(self.listed(&meta)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(self.failed("find", digest)(error)),
        }
    }

    fn list(&self, show: &mut dyn FnMut(StoredArtefact)) -> Result<(), ArtefactError> {
        let (store, prefix) = (self.store.clone(), self.prefix.clone());
        // A folder is read on threads of the runtime on which the list is made.
        let open = async move { Ok(store.list(Some(&prefix))) };
        show_listed(&self.calls, &self.name, open, &mut |meta: ObjectMeta| {
            if let Some(artefact) = self.listed(&meta) {
                show(artefact);
            }
        })
    }

    fn remove_older(&self, digest: &ArtefactDigest, least: Duration) -> Result<bool, ArtefactError> {
        if let Some(folder) = &self.folder {
            return Ok(folder::remove_older(folder, digest, least)?);
        }
        // S3 removes without a condition: who has stored it again since this looks once more whether it is there.
        if !self.find(digest)?.is_some_and(|there| there.is_older(least)) {
            return Ok(false);
        }
        let (store, key) = (self.store.clone(), self.key(digest));
        let removed = self.calls.wait(async move { store.delete(&key).await });
        match removed.map_err(self.failed::<ShutDown>("remove", digest))? {
            Ok(()) => Ok(true),
            Err(object_store::Error::NotFound { .. }) => Ok(false),
            Err(error) => Err(self.failed("remove", digest)(error)),
        }
    }

    fn bring_back(&self) -> Result<(), ArtefactError> {
        Ok(self.folder.as_ref().map_or(Ok(()), |folder| folder::bring_back(folder))?)
    }

    fn remove_interrupted(&self, least: Duration) -> Result<(), ArtefactError> {
        Ok(self.folder.as_ref().map_or(Ok(()), |folder| folder::remove_interrupted(folder, least))?)
    }

    fn put(&self, digest: &ArtefactDigest, file: &FilePath) -> Result<(), ArtefactError> {
        let there = self.find(digest)?;
        if there.is_some_and(|there| !there.is_older(self.renewed_after) || self.touch(digest)) {
            return Ok(());
        }
        // One that is old is written over, with the same bytes. So is one of a folder that comes back only now: it may be old.
        let over = there.is_some() || self.folder.is_some();
        let mode = if over { PutMode::Overwrite } else { PutMode::Create };
        self.store_bytes(digest, file, mode)?;
        // A removal that had found the old one may have hit the new one.
        if there.is_some() && self.folder.is_none() && !self.has(digest)? {
            self.store_bytes(digest, file, PutMode::Create)?;
        }
        Ok(())
    }

    fn get(
        &self,
        digest: &ArtefactDigest,
        bytes: RangeInclusive<u64>,
        to: &FilePath,
    ) -> Result<(), ArtefactError> {
        let (store, key) = (self.store.clone(), self.key(digest));
        let found = self.calls.wait(async move { store.get(&key).await });
        let found = match found.map_err(self.failed::<ShutDown>("fetch", digest))? {
            Ok(found) => found,
            Err(object_store::Error::NotFound { .. }) => {
                return Err(ArtefactError::Missing { store: self.name.clone(), digest: *digest });
            }
            Err(error) => return Err(self.failed("fetch", digest)(error)),
        };
        let (send, mut pieces) = tokio::sync::mpsc::channel(AHEAD);
        let failed = self.failed::<object_store::Error>("fetch", digest);
        let late = self.failed::<tokio::time::error::Elapsed>("fetch", digest);
        // Ends when the file is whole, or nobody takes a piece any more.
        let _under_way = self.calls.start(async move {
            let mut stream = found.into_stream();
            loop {
                let piece = match tokio::time::timeout(SILENCE, stream.next()).await {
                    Ok(Some(piece)) => piece.map_err(&failed),
                    Ok(None) => break,
                    Err(elapsed) => Err(late(elapsed)),
                };
                let ends = piece.is_err();
                if send.send(piece).await.is_err() || ends {
                    break;
                }
            }
        });
        receive(&self.name, digest, &bytes, to, || pieces.blocking_recv())
    }
}
