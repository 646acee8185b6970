//! Zip archives, as far as `.sog` needs them: files that are stored or deflated, found by the list at the end of the
//! archive (PKWARE's APPNOTE, section 4.3).

use super::program::plain;
use crate::SceneError;
use flate2::Crc;
use flate2::read::DeflateDecoder;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

/// How an archive begins, how a file in its list does, and the end of that.
const LOCAL: &[u8; 4] = b"PK\x03\x04";
const LISTED: &[u8; 4] = b"PK\x01\x02";
const END: &[u8; 4] = b"PK\x05\x06";
/// Bytes of these without names and comments.
const LOCAL_LENGTH: usize = 30;
const LISTED_LENGTH: usize = 46;
const END_LENGTH: usize = 22;
/// The longest comment after the end of the list.
const LONGEST_COMMENT: usize = u16::MAX as usize;
/// Bit of the flags of an encrypted file.
const ENCRYPTED: usize = 1;
const STORED: usize = 0;
const DEFLATED: usize = 8;

/// A file as the list has it.
struct ZipEntry {
    encrypted: bool,
    method: usize,
    crc: usize,
    /// Bytes in the archive, and where its own header stands.
    packed: usize,
    at: usize,
}

/// An archive and the list of its files.
pub(super) struct ZipArchive<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    entries: BTreeMap<String, ZipEntry>,
}

/// Whether a file begins as an archive.
pub(super) fn is_archive(start: &[u8]) -> bool {
    start.starts_with(LOCAL)
}

/// The number of `size` bytes at a position, at most four.
fn number(bytes: &[u8], at: usize, size: usize) -> Option<usize> {
    let bytes = bytes.get(at..at.checked_add(size)?)?;
    Some(bytes.iter().rev().fold(0, |value, &byte| value << 8 | usize::from(byte)))
}

impl<'a> ZipArchive<'a> {
    /// Reads the list of the files.
    pub fn open(path: &'a Path, bytes: &'a [u8]) -> Result<ZipArchive<'a>, SceneError> {
        let invalid = |reason: &str| SceneError::invalid(path, "the list of its files", reason);
        let last = bytes.len().checked_sub(END_LENGTH).ok_or_else(|| invalid("the archive is cut short"))?;
        let first = last.saturating_sub(LONGEST_COMMENT);
        let end = (first..=last).rev().find(|&at| bytes[at..].starts_with(END));
        let end = end.ok_or_else(|| invalid("it is missing: the archive is cut short, or no archive"))?;
        let parts = number(bytes, end + 10, 2).zip(number(bytes, end + 16, 4));
        let (count, mut at) = parts.ok_or_else(|| invalid("it is cut short"))?;
        let mut entries = BTreeMap::new();
        for _ in 0..count {
            let entry = ZipArchive::entry(bytes, at);
            let (name, entry, next) = entry.ok_or_else(|| invalid("it is damaged"))?;
            entries.insert(name, entry);
            at = next;
        }
        Ok(ZipArchive { path, bytes, entries })
    }

    /// The file that the list has at a position: its name, where it lies, and the position of the next one.
    fn entry(bytes: &[u8], at: usize) -> Option<(String, ZipEntry, usize)> {
        bytes.get(at..)?.starts_with(LISTED).then_some(())?;
        let of = |offset: usize, size: usize| number(bytes, at + offset, size);
        let entry = ZipEntry {
            encrypted: of(8, 2)? & ENCRYPTED != 0,
            method: of(10, 2)?,
            crc: of(16, 4)?,
            packed: of(20, 4)?,
            at: of(42, 4)?,
        };
        let [name, extra, comment] = [of(28, 2)?, of(30, 2)?, of(32, 2)?];
        let start = at + LISTED_LENGTH;
        let text = String::from_utf8_lossy(bytes.get(start..start + name)?).into_owned();
        Some((text, entry, start + name + extra + comment))
    }

    /// The bytes of a file, which may have `most`.
    pub fn read(&self, name: &str, most: usize) -> Result<Vec<u8>, SceneError> {
        let location = || format!("`{}` in the archive", plain(name));
        let invalid = |reason: String| SceneError::invalid(self.path, location(), reason);
        let entry = self.entries.get(name).ok_or_else(|| invalid("it is missing".into()))?;
        if entry.encrypted {
            return Err(invalid("it is encrypted".into()));
        }
        let packed = self.packed(entry).ok_or_else(|| invalid("it is cut short".into()))?;
        let mut data = Vec::new();
        // One byte more shows that it is too large.
        let limit = (most as u64).saturating_add(1);
        let unpacked = match entry.method {
            STORED => packed.take(limit).read_to_end(&mut data),
            DEFLATED => DeflateDecoder::new(packed).take(limit).read_to_end(&mut data),
            method => return Err(invalid(format!("it is packed by method {method}, which is not read"))),
        };
        unpacked.map_err(|e| invalid(format!("it cannot be unpacked: {e}")))?;
        if data.len() > most {
            return Err(invalid(format!("it has more than {most} bytes")));
        }
        let mut crc = Crc::new();
        crc.update(&data);
        if crc.sum() as usize != entry.crc {
            return Err(invalid("its check sum does not fit: the file is damaged".into()));
        }
        Ok(data)
    }

    /// The bytes of a file as they lie in the archive.
    fn packed(&self, entry: &ZipEntry) -> Option<&'a [u8]> {
        let own = self.bytes.get(entry.at..)?;
        own.starts_with(LOCAL).then_some(())?;
        let start = LOCAL_LENGTH + number(own, 26, 2)? + number(own, 28, 2)?;
        own.get(start..start.checked_add(entry.packed)?)
    }
}
