//! Artefacts by content key, in a folder.
//!
//! ```text
//! root/masks.d/ab/abcdef.. magic 8 | payload length u64 | blake3 32 | payload
//! root/tmp/                written aside, renamed when whole
//! root/corrupt/            what did not verify, moved out of the way
//! ```
//!
//! Nothing is trusted: every read verifies the hash, and a torn or altered file is a miss. Several threads and
//! processes may share a cache; two that make the same artefact write the same bytes, and the last rename wins.
//!
//! ```
//! use segwild_flow::{Cache, Key, Origin};
//! let folder = tempfile::tempdir().unwrap();
//! let cache = Cache::open(folder.path()).unwrap();
//! let key = Key::of("areas").part("photo", b"..").finish();
//! let make = || Ok::<_, std::fmt::Error>(vec![1.0f32, 2.0]);
//! assert_eq!(cache.get_or_make(&key, "areas/1", make).unwrap(), (vec![1.0, 2.0], Origin::Made));
//! assert_eq!(cache.get_or_make(&key, "areas/1", make).unwrap(), (vec![1.0, 2.0], Origin::Cache));
//! assert_eq!((cache.counters().hits, cache.counters().misses), (1, 1));
//! ```

mod inventory;

use std::collections::BTreeSet;
use std::fs;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use crate::codec::{self, CodecError, Decode, Encode, StreamedRecord};
use crate::fault;
use crate::files::{self, FileError};
use crate::key::Key;
use crate::lock;

pub use inventory::{Artefact, Swept};

const MAGIC: [u8; 8] = *b"\x89SGA\r\n\x1a\x01";
const HEADER: usize = 8 + 8 + 32;

/// Why the cache could not serve. A missing or damaged artefact is no error but a miss.
#[derive(Debug, thiserror::Error)]
pub enum CacheError {
    /// The folder could not be read or written.
    #[error("{0}")]
    File(#[from] FileError),
    /// The value has no record form.
    #[error(transparent)]
    Codec(#[from] CodecError),
}

/// Why [`Cache::get_or_make`] has no value.
#[derive(Debug, thiserror::Error)]
pub enum MakeError<E: std::error::Error + 'static> {
    /// The cache could not serve.
    #[error("{0}")]
    Cache(#[from] CacheError),
    /// The value could not be made.
    #[error(transparent)]
    Make(E),
}

/// Where a value came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// It was there.
    Cache,
    /// It was made now.
    Made,
}

/// What a cache has done since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct CacheCounters {
    /// Reads that found a whole artefact.
    pub hits: u64,
    /// Reads that found none, damaged ones included.
    pub misses: u64,
    /// Damaged artefacts, moved aside.
    pub corrupt: u64,
    /// Payload bytes read.
    pub bytes_read: u64,
    /// Payload bytes written.
    pub bytes_written: u64,
}

#[derive(Default)]
struct Counters {
    hits: AtomicU64,
    misses: AtomicU64,
    corrupt: AtomicU64,
    bytes_read: AtomicU64,
    bytes_written: AtomicU64,
}

/// Called once per damaged artefact, with its key as the ledger writes it and what is wrong with it.
type DamageListener = Box<dyn Fn(&str, &str) + Send + Sync>;

/// What was found damaged since the cache was opened.
#[derive(Default)]
struct DamageReports {
    keys: Mutex<BTreeSet<String>>,
    listener: OnceLock<DamageListener>,
}

/// The header of an artefact of so many bytes and of this hash.
fn header(bytes: u64, hash: &[u8; 32]) -> [u8; HEADER] {
    let mut header = [0; HEADER];
    header[..8].copy_from_slice(&MAGIC);
    header[8..16].copy_from_slice(&bytes.to_le_bytes());
    header[16..].copy_from_slice(hash);
    header
}

/// Whether a file's bytes are a whole artefact; else what is wrong with them.
fn check(bytes: &[u8]) -> Result<(), &'static str> {
    if bytes.len() < HEADER {
        Err("it is shorter than its header")
    } else if bytes[..8] != MAGIC {
        Err("it does not start as an artefact does")
    } else if bytes[8..16] != ((bytes.len() - HEADER) as u64).to_le_bytes() {
        Err("its length is not the one written down")
    } else if bytes[16..HEADER] != *blake3::hash(&bytes[HEADER..]).as_bytes() {
        Err("its hash does not fit its bytes")
    } else {
        Ok(())
    }
}

/// A content-addressed store. Clones share the counters.
#[derive(Clone)]
pub struct Cache {
    root: PathBuf,
    counters: Arc<Counters>,
    damage: Arc<DamageReports>,
}

impl Cache {
    /// Opens the cache in a folder, which is created.
    ///
    /// # Errors
    /// When the folder cannot be created.
    pub fn open(root: impl Into<PathBuf>) -> Result<Self, CacheError> {
        let root = root.into();
        fs::create_dir_all(&root).map_err(|e| FileError::new("create the cache folder", &root, e))?;
        Ok(Self::at(root))
    }

    /// The cache in a folder that may not be there: it then holds nothing, and nothing is made.
    pub fn at(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into(), counters: Arc::default(), damage: Arc::default() }
    }

    /// Calls a function once for each artefact that is found damaged: with its key as the ledger writes it, and what is
    /// wrong with it. One function in all, for the cache and its clones: the first.
    pub fn on_damage(&self, listener: impl Fn(&str, &str) + Send + Sync + 'static) {
        let _ = self.damage.listener.set(Box::new(listener));
    }

    /// Whether the artefact of a key has been found damaged since the cache was opened.
    pub fn was_damaged(&self, key: &Key) -> bool {
        lock(&self.damage.keys).contains(&key.to_string())
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Where the artefact of a key lies, if it is there.
    pub fn path(&self, key: &Key) -> PathBuf {
        // A domain is code, not input; yet whatever it holds stays one folder below the root.
        let safe = |c: char| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' };
        let hex = key.hex();
        self.root
            .join(format!("{}.d", key.domain().chars().map(safe).collect::<String>()))
            .join(&hex[..2])
            .join(hex)
    }

    /// Whether a file of this key is there; it is verified only when it is read.
    pub fn contains(&self, key: &Key) -> bool {
        self.path(key).is_file()
    }

    /// Stores an artefact: written aside, synced, renamed.
    ///
    /// # Errors
    /// In words: disk full, read-only, denied. The cache then is as it was before.
    pub fn put(&self, key: &Key, bytes: &[u8]) -> Result<(), CacheError> {
        let header = header(bytes.len() as u64, blake3::hash(bytes).as_bytes());
        files::write_aside(&self.root.join("tmp"), &self.path(key), &[&header, bytes])?;
        self.counters.bytes_written.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok(())
    }

    /// Reads and verifies an artefact; `None` when it is not there or damaged (then it is moved aside).
    ///
    /// # Errors
    /// When the file is there but cannot be read.
    pub fn get(&self, key: &Key) -> Result<Option<Vec<u8>>, CacheError> {
        let found = self.read(key)?;
        self.count(found.as_ref().map(Vec::len));
        Ok(found)
    }

    /// Reads a typed artefact, or makes and stores it. `kind` is the record's kind ([`codec::encode`]); a file
    /// that holds anything else is treated as damaged.
    ///
    /// # Errors
    /// When the value cannot be made, or the cache cannot be read or written.
    pub fn get_or_make<T, E>(
        &self,
        key: &Key,
        kind: &str,
        make: impl FnOnce() -> Result<T, E>,
    ) -> Result<(T, Origin), MakeError<E>>
    where
        T: Encode + Decode,
        E: std::error::Error + 'static,
    {
        if let Some(value) = self.get_typed(key, kind)? {
            return Ok((value, Origin::Cache));
        }
        let value = make().map_err(MakeError::Make)?;
        self.put_typed(key, kind, &value)?;
        Ok((value, Origin::Made))
    }

    /// Reads a typed artefact; see [`Cache::get`].
    ///
    /// # Errors
    /// When the file is there but cannot be read.
    pub fn get_typed<T: Decode>(&self, key: &Key, kind: &str) -> Result<Option<T>, CacheError> {
        let bytes = self.read(key)?;
        let value = bytes.as_ref().and_then(|bytes| match codec::decode(kind, bytes) {
            Ok(value) => Some(value),
            Err(error) => {
                self.move_aside(key, &error.to_string());
                None
            }
        });
        self.count(value.as_ref().and(bytes.as_ref()).map(Vec::len));
        Ok(value)
    }

    /// Stores a typed artefact; see [`Cache::put`]. Its bytes are never held at once.
    ///
    /// # Errors
    /// As [`Cache::put`], and when the value has no record form.
    pub fn put_typed<T: Encode + ?Sized>(&self, key: &Key, kind: &str, value: &T) -> Result<(), CacheError> {
        let record = StreamedRecord::of(kind, value)?;
        let path = self.path(key);
        files::write_aside_with(&self.root.join("tmp"), &path, |file| -> Result<(), FileError> {
            // The header holds the hash of what follows it: it is written last.
            let written = file.write_all(&[0; HEADER]).and_then(|()| record.write(&mut *file));
            let written = written.and_then(|hash| {
                file.seek(SeekFrom::Start(0))?;
                file.write_all(&header(record.bytes(), &hash))
            });
            written.map_err(|e| FileError::new("write", &path, e))
        })?;
        self.counters.bytes_written.fetch_add(record.bytes(), Ordering::Relaxed);
        Ok(())
    }

    /// What was done since the cache was opened.
    pub fn counters(&self) -> CacheCounters {
        let c = &self.counters;
        let read = |n: &AtomicU64| n.load(Ordering::Relaxed);
        CacheCounters {
            hits: read(&c.hits),
            misses: read(&c.misses),
            corrupt: read(&c.corrupt),
            bytes_read: read(&c.bytes_read),
            bytes_written: read(&c.bytes_written),
        }
    }

    fn count(&self, found: Option<usize>) {
        match found {
            Some(bytes) => {
                self.counters.hits.fetch_add(1, Ordering::Relaxed);
                self.counters.bytes_read.fetch_add(bytes as u64, Ordering::Relaxed);
            }
            None => {
                self.counters.misses.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    fn read(&self, key: &Key) -> Result<Option<Vec<u8>>, CacheError> {
        let path = self.path(key);
        let mut bytes = match codec::read_file(&path) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(FileError::new("read", &path, e).into()),
        };
        if fault::armed() {
            let read = fault::bytes("cache.read", bytes.into());
            bytes = read.map_err(|e| FileError::new("read", &path, e))?.into_owned();
        }
        match check(&bytes) {
            Ok(()) => {
                bytes.drain(..HEADER);
                Ok(Some(bytes))
            }
            Err(reason) => {
                self.move_aside(key, reason);
                Ok(None)
            }
        }
    }

    fn move_aside(&self, key: &Key, reason: &str) {
        self.move_file_aside(&self.path(key), &key.to_string(), reason);
    }

    /// `key` is as the ledger writes it.
    fn move_file_aside(&self, from: &Path, key: &str, reason: &str) {
        self.counters.corrupt.fetch_add(1, Ordering::Relaxed);
        tracing::warn!("{} is damaged ({reason}): made again", from.display());
        let first = lock(&self.damage.keys).insert(key.to_owned());
        if let Some(listener) = self.damage.listener.get().filter(|_| first) {
            listener(key, reason);
        }
        let folder = self.root.join("corrupt");
        let to = folder.join(files::unique_name(&key.replace(':', "-")));
        // Where the folder cannot be written, the damaged file stays and stays a miss.
        let _ = fs::create_dir_all(&folder).and_then(|()| fs::rename(from, to));
    }
}
