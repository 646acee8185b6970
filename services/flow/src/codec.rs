//! Binary records: bincode's format behind a header that says what the bytes are.
//!
//! ```text
//! magic 8 | format version u16 | kind length u8 | kind | payload length u64 | blake3 32 | payload
//! ```
//!
//! Integers are little-endian. The hash covers the kind and the payload, so a record that was renamed, cut or
//! altered is refused before a single field is read. The payload is `wincode`'s encoding, which equals
//! bincode 1's byte for byte; records that change shape change their kind (`masks/1` -> `masks/2`), since the
//! format does not describe itself.
//!
//! ```
//! use segwild_flow::codec::{self, CodecError};
//! #[derive(wincode::SchemaWrite, wincode::SchemaRead, Debug, PartialEq)]
//! struct Masks { view: u32, areas: Vec<f32> }
//!
//! let masks = Masks { view: 7, areas: vec![0.5, 0.25] };
//! let mut bytes = codec::encode("masks/1", &masks).unwrap();
//! assert_eq!(codec::decode::<Masks>("masks/1", &bytes).unwrap(), masks);
//!
//! assert!(matches!(codec::decode::<Masks>("masks/2", &bytes), Err(CodecError::Kind { .. })));
//! *bytes.last_mut().unwrap() ^= 1;
//! assert!(matches!(codec::decode::<Masks>("masks/1", &bytes), Err(CodecError::Corrupt { .. })));
//! ```

use crate::files::{self, FileError};
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use wincode::config::Configuration;
use wincode::len::BincodeLen;
use wincode::{SchemaRead, SchemaWrite};

/// Most bytes a record may have, header included: 8 GiB. A checkpoint of 5 million splats takes 3.3 GiB: 59 parameters
/// each, and two moments of each parameter. Larger data is split by its owner.
pub const SIZE_LIMIT: usize = 8 << 30;

/// Most bytes of a file that holds a record, perhaps behind a header of its own.
const FILE_LIMIT: u64 = SIZE_LIMIT as u64 + (1 << 20);

/// Version of the header and of the encoding's configuration.
pub const FORMAT_VERSION: u16 = 1;

/// Not text, and broken by any transfer that rewrites line ends (the idea of PNG's signature).
const MAGIC: [u8; 8] = *b"\x89SGW\r\n\x1a\n";
const KIND_LIMIT: usize = 64;
/// Bytes of the header without the kind.
const FIXED_HEADER: usize = 8 + 2 + 1 + 8 + 32;
/// Bytes that are gathered before they are hashed and written.
const STREAM_BUFFER: usize = 64 << 10;

/// Bincode 1's bytes, with a limit to what one sequence may take before its elements are seen.
type Limited<const BYTES: usize> = Configuration<
    true,
    BYTES,
    BincodeLen,
    wincode::int_encoding::LittleEndian,
    wincode::int_encoding::FixInt,
    u32,
    SIZE_LIMIT,
>;

/// The encoding's configuration: the limit is raised on purpose from 4 MiB, which `wincode` applies when it writes, too.
pub type Config = Limited<SIZE_LIMIT>;

/// A short payload that claims a long sequence is refused before memory is taken for it: in memory an element takes at most
/// a few dozen times as many bytes as in a record, an absent one of a list for instance.
const SHORT: usize = 256 << 10;
const MIDDLING: usize = 16 * SHORT;
const LONG: usize = SIZE_LIMIT / 64;
type ForShort = Limited<{ 64 * SHORT }>;
type ForMiddling = Limited<{ 64 * MIDDLING }>;
type ForLong = Limited<{ 1 << 30 }>;

/// Types that can be written: those that derive `wincode::SchemaWrite`.
pub trait Encode: SchemaWrite<Config, Src = Self> {}
impl<T: SchemaWrite<Config, Src = T> + ?Sized> Encode for T {}

/// Types that can be read: those that derive `wincode::SchemaRead`.
pub trait Decode:
    for<'de> SchemaRead<'de, Config, Dst = Self>
    + for<'de> SchemaRead<'de, ForShort, Dst = Self>
    + for<'de> SchemaRead<'de, ForMiddling, Dst = Self>
    + for<'de> SchemaRead<'de, ForLong, Dst = Self>
{
}
impl<T> Decode for T where
    T: for<'de> SchemaRead<'de, Config, Dst = T>
        + for<'de> SchemaRead<'de, ForShort, Dst = T>
        + for<'de> SchemaRead<'de, ForMiddling, Dst = T>
        + for<'de> SchemaRead<'de, ForLong, Dst = T>
{
}

/// Why bytes are no record, or a value cannot become one.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// Fewer bytes than the header promises.
    #[error("the record is cut short: {found} bytes of it are there, and it has at least {expected}")]
    Truncated {
        /// Bytes there should be at least: where the header itself is cut short, it does not say how many more follow.
        expected: u64,
        /// Bytes there are.
        found: u64,
    },
    /// The bytes do not start as a record does.
    #[error("this is not a record of this program")]
    Foreign,
    /// Written by another version of the format.
    #[error("record format {found}, this program reads format {FORMAT_VERSION}: make it again")]
    Version {
        /// The record's format.
        found: u16,
    },
    /// A record, but of something else.
    #[error("the record holds `{found}` where `{expected}` was wanted")]
    Kind {
        /// What was requested.
        expected: String,
        /// What the header says.
        found: String,
    },
    /// The hash does not fit the bytes.
    #[error("the record `{kind}` is damaged: {reason}")]
    Corrupt {
        /// What the header says it holds.
        kind: String,
        /// What does not fit.
        reason: String,
    },
    /// Over [`SIZE_LIMIT`].
    #[error("the record `{kind}` has {bytes} bytes, the limit is {SIZE_LIMIT}")]
    TooLarge {
        /// What it holds.
        kind: String,
        /// Its size.
        bytes: u64,
    },
    /// A kind must be 1-64 bytes of printable ASCII.
    #[error("`{0}` cannot name a kind of record: 1 to 64 printable ASCII characters are needed")]
    KindName(String),
    /// The value cannot be written.
    #[error("the value cannot be written as `{kind}`: {reason}")]
    Write {
        /// What it was to hold.
        kind: String,
        /// What `wincode` says.
        reason: String,
    },
}

fn check_kind(kind: &str) -> Result<(), CodecError> {
    if kind.is_empty() || kind.len() > KIND_LIMIT || !kind.bytes().all(|b| b.is_ascii_graphic()) {
        return Err(CodecError::KindName(kind.chars().take(KIND_LIMIT).collect()));
    }
    Ok(())
}

/// The hash of a record, before its payload.
fn hasher(kind: &str) -> blake3::Hasher {
    let mut hasher = blake3::Hasher::new_derive_key("segwild record 1");
    hasher.update(&[kind.len() as u8]).update(kind.as_bytes());
    hasher
}

fn header(kind: &str, payload: u64, hash: &blake3::Hash) -> Vec<u8> {
    let mut header = Vec::with_capacity(FIXED_HEADER + kind.len());
    header.extend_from_slice(&MAGIC);
    header.extend_from_slice(&FORMAT_VERSION.to_le_bytes());
    header.push(kind.len() as u8);
    header.extend_from_slice(kind.as_bytes());
    header.extend_from_slice(&payload.to_le_bytes());
    header.extend_from_slice(hash.as_bytes());
    header
}

/// Bytes of a value's payload, where a record of the kind can hold it.
fn payload_size<T: Encode + ?Sized>(kind: &str, value: &T) -> Result<u64, CodecError> {
    check_kind(kind)?;
    let too_large = |bytes| CodecError::TooLarge { kind: kind.into(), bytes };
    let size = match wincode::config::serialized_size(value, Config::new()) {
        Ok(size) => size,
        Err(wincode::WriteError::PreallocationSizeLimit { needed, .. }) => {
            return Err(too_large(needed as u64));
        }
        Err(e) => return Err(write_error(kind, &e)),
    };
    let whole = size.saturating_add((FIXED_HEADER + kind.len()) as u64);
    if whole > SIZE_LIMIT as u64 { Err(too_large(whole)) } else { Ok(size) }
}

fn write_error(kind: &str, error: &wincode::WriteError) -> CodecError {
    CodecError::Write { kind: kind.into(), reason: error.to_string() }
}

/// Writes a value as a record of a kind (`name/version` by custom, at most 64 printable ASCII characters).
/// [`StreamedRecord`] writes large ones without holding them.
///
/// # Errors
/// When the kind's name does not serve, or the record would pass [`SIZE_LIMIT`].
pub fn encode<T: Encode + ?Sized>(kind: &str, value: &T) -> Result<Vec<u8>, CodecError> {
    let size = payload_size(kind, value)?;
    let start = FIXED_HEADER + kind.len();
    let mut bytes = Vec::with_capacity(start + size as usize);
    bytes.resize(start, 0);
    wincode::config::serialize_into(&mut bytes, value, Config::new()).map_err(|e| write_error(kind, &e))?;
    let payload = &bytes[start..];
    let header = header(kind, payload.len() as u64, &hasher(kind).update(payload).finalize());
    bytes[..start].copy_from_slice(&header);
    Ok(bytes)
}

/// A value about to be written as a record, with the same bytes as [`encode`] makes, which are never held at once. The
/// value is encoded twice: for the hash in the header, and for the file.
///
/// ```
/// use segwild_flow::codec::{StreamedRecord, encode, read_file};
/// let folder = tempfile::tempdir().unwrap();
/// let (path, areas) = (folder.path().join("areas.bin"), vec![0.5f32, 0.25]);
/// let record = StreamedRecord::of("areas/1", &areas).unwrap();
/// record.write_file(&path).unwrap();
/// assert_eq!(read_file(&path).unwrap(), encode("areas/1", &areas).unwrap());
/// ```
pub struct StreamedRecord<'a, T: ?Sized> {
    header: Vec<u8>,
    /// Bytes of the payload.
    payload: u64,
    value: &'a T,
}

impl<'a, T: Encode + ?Sized> StreamedRecord<'a, T> {
    /// Encodes a value for its size and its hash.
    ///
    /// # Errors
    /// As [`encode`].
    pub fn of(kind: &str, value: &'a T) -> Result<StreamedRecord<'a, T>, CodecError> {
        payload_size(kind, value)?;
        let mut payload = MeasuringWriter { out: io::sink(), hasher: hasher(kind), bytes: 0 };
        stream(value, &mut payload).map_err(|e| write_error(kind, &e))?;
        let header = header(kind, payload.bytes, &payload.hasher.finalize());
        Ok(StreamedRecord { header, payload: payload.bytes, value })
    }

    /// Bytes of the whole record.
    pub fn bytes(&self) -> u64 {
        self.header.len() as u64 + self.payload
    }

    /// Writes the record to `out`. Returns the BLAKE3 hash of all its bytes.
    ///
    /// # Errors
    /// Those of `out`.
    pub fn write(&self, out: impl Write) -> io::Result<[u8; 32]> {
        let mut out = MeasuringWriter { out, hasher: blake3::Hasher::new(), bytes: 0 };
        out.write_all(&self.header)?;
        stream(self.value, &mut out).map_err(|error| match error {
            wincode::WriteError::Io(wincode::io::WriteError::Io(error)) => error,
            other => io::Error::other(other.to_string()),
        })?;
        // A value that changes while it is written, by an inner lock for instance, has no header that fits it.
        if out.bytes != self.bytes() {
            return Err(io::Error::other("its value changed while it was written"));
        }
        Ok(*out.hasher.finalize().as_bytes())
    }

    /// Writes the record as a file, as by [`files::write_atomic`]. Returns the BLAKE3 hash of the file.
    ///
    /// # Errors
    /// In words: disk full, read-only, denied.
    pub fn write_file(&self, path: &Path) -> Result<[u8; 32], FileError> {
        let mut hash = [0; 32];
        files::write_with(path, |file| -> Result<(), FileError> {
            hash = self.write(file).map_err(|e| FileError::new("write", path, e))?;
            Ok(())
        })?;
        Ok(hash)
    }
}

/// Encodes a value bit by bit.
fn stream<T: Encode + ?Sized>(value: &T, out: impl Write) -> Result<(), wincode::WriteError> {
    // Long arrays pass the buffer by.
    let mut buffered = BufWriter::with_capacity(STREAM_BUFFER, out);
    wincode::config::serialize_into(&mut buffered, value, Config::new())
}

/// Hashes and counts what is written.
struct MeasuringWriter<W> {
    out: W,
    hasher: blake3::Hasher,
    bytes: u64,
}

impl<W: Write> Write for MeasuringWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.out.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

/// Splits a record into its kind and its payload, after checking everything but the payload's fields.
///
/// # Errors
/// Anything that is not a whole, undamaged record.
pub fn open(bytes: &[u8]) -> Result<(&str, &[u8]), CodecError> {
    let truncated =
        |expected: usize| CodecError::Truncated { expected: expected as u64, found: bytes.len() as u64 };
    let start = bytes.len().min(MAGIC.len());
    if bytes[..start] != MAGIC[..start] {
        return Err(CodecError::Foreign);
    }
    if bytes.len() < FIXED_HEADER {
        return Err(truncated(FIXED_HEADER));
    }
    let found = u16::from_le_bytes([bytes[8], bytes[9]]);
    if found != FORMAT_VERSION {
        return Err(CodecError::Version { found });
    }
    let header = FIXED_HEADER + usize::from(bytes[10]);
    let name = bytes.get(11..11 + usize::from(bytes[10])).ok_or_else(|| truncated(header))?;
    let kind = std::str::from_utf8(name).map_err(|_| CodecError::Foreign)?;
    check_kind(kind).map_err(|_| CodecError::Foreign)?;
    if bytes.len() < header {
        return Err(truncated(header));
    }
    let tail = 11 + kind.len();
    let mut length = [0; 8];
    length.copy_from_slice(&bytes[tail..tail + 8]);
    let length = u64::from_le_bytes(length);
    if length > SIZE_LIMIT as u64 {
        return Err(CodecError::TooLarge { kind: kind.into(), bytes: length });
    }
    let payload = &bytes[header..];
    let corrupt = |reason: String| CodecError::Corrupt { kind: kind.into(), reason };
    match (payload.len() as u64).cmp(&length) {
        std::cmp::Ordering::Less => return Err(truncated(header + length as usize)),
        std::cmp::Ordering::Greater => {
            return Err(corrupt(format!("{} bytes too many", payload.len() as u64 - length)));
        }
        std::cmp::Ordering::Equal => {}
    }
    if *hasher(kind).update(payload).finalize().as_bytes() != bytes[tail + 8..header] {
        return Err(corrupt("its hash does not fit its bytes".into()));
    }
    Ok((kind, payload))
}

/// All bytes of a file that holds a record, to be decoded.
///
/// # Errors
/// As [`files::read_within`].
pub fn read_file(path: &Path) -> io::Result<Vec<u8>> {
    files::read_within(path, FILE_LIMIT)
}

/// A file that holds a record, to be read bit by bit, and its length in bytes.
///
/// # Errors
/// As [`files::open_within`].
pub fn open_file(path: &Path) -> io::Result<(File, u64)> {
    files::open_within(path, FILE_LIMIT)
}

/// Reads a record of a kind. Never panics, whatever the bytes; takes at most 64 times as much memory for one sequence as
/// the payload has bytes (and at least 16 MiB, or 1 GiB where it has more than 4 MiB) before its elements are seen.
///
/// # Errors
/// Anything that is not a whole, undamaged record of this kind.
pub fn decode<T: Decode>(kind: &str, bytes: &[u8]) -> Result<T, CodecError> {
    let (found, payload) = open(bytes)?;
    if found != kind {
        return Err(CodecError::Kind { expected: kind.into(), found: found.into() });
    }
    let read = if payload.len() <= SHORT {
        wincode::config::deserialize_exact(payload, ForShort::new())
    } else if payload.len() <= MIDDLING {
        wincode::config::deserialize_exact(payload, ForMiddling::new())
    } else if payload.len() <= LONG {
        wincode::config::deserialize_exact(payload, ForLong::new())
    } else {
        wincode::config::deserialize_exact(payload, Config::new())
    };
    read.map_err(|e| CodecError::Corrupt { kind: kind.into(), reason: e.to_string() })
}
