//! TIFFs: how many values the first directory claims. Their decoder allocates memory for all of them before it reads one.

use super::DecodeError;
use std::io::{Read, Seek, SeekFrom};

/// Most entries of a directory: only a BigTIFF can claim more.
const MOST_ENTRIES: u64 = 65_536;

/// Bytes of a value, by its type.
fn size_of(kind: u16) -> u64 {
    match kind {
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        5 | 10 | 12 | 16..=18 => 8,
        _ => 1,
    }
}

/// Numbers of a file, in its order of bytes.
struct TiffReader<R> {
    file: R,
    big_endian: bool,
}

impl<R: Read + Seek> TiffReader<R> {
    fn next(&mut self, bytes: usize) -> Option<u64> {
        let mut read = [0; 8];
        self.file.read_exact(&mut read[..bytes]).ok()?;
        let fold = |n: u64, &b: &u8| n << 8 | u64::from(b);
        let read = &read[..bytes];
        Some(if self.big_endian { read.iter().fold(0, fold) } else { read.iter().rev().fold(0, fold) })
    }

    /// Goes to the first directory; bytes of an offset there.
    fn first_directory(&mut self) -> Option<usize> {
        let mut order = [0; 2];
        self.file.read_exact(&mut order).ok()?;
        self.big_endian = &order == b"MM";
        let wide = self.next(2)? == 43;
        let bytes = if wide { 8 } else { 4 };
        if wide {
            self.next(4)?;
        }
        let at = self.next(bytes)?;
        self.file.seek(SeekFrom::Start(at)).ok()?;
        Some(bytes)
    }

    /// Looks for more entries than any TIFF has, and for an entry whose values take more than the `length` bytes of the file.
    fn too_many(&mut self, length: u64) -> Option<DecodeError> {
        let bytes = self.first_directory()?;
        let entries = self.next(if bytes == 8 { 8 } else { 2 })?;
        if entries > MOST_ENTRIES {
            let reason = "the TIFF's directory claims more than 65,536 entries: it is damaged; copy it again";
            return Some(DecodeError::Malformed(reason));
        }
        for _ in 0..entries {
            let (tag, kind, count) = (self.next(2)?, self.next(2)?, self.next(bytes)?);
            self.next(bytes)?;
            if count.saturating_mul(size_of(kind as u16)) > length {
                return Some(DecodeError::TiffCount { tag, count, bytes: length });
            }
        }
        None
    }
}

/// Refuses a file of `length` bytes whose first directory claims more entries than any has, or more values than these can hold.
pub(crate) fn check_counts(file: impl Read + Seek, length: u64) -> Result<(), DecodeError> {
    TiffReader { file, big_endian: false }.too_many(length).map_or(Ok(()), Err)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bigtiff_whose_directory_claims_endless_entries_is_refused_before_they_are_read() {
        let claims = |entries: u64| {
            let mut file = b"II\x2b\0\x08\0\0\0\x10\0\0\0\0\0\0\0".to_vec();
            file.extend(entries.to_le_bytes());
            check_counts(std::io::Cursor::new(file), 1 << 40)
        };
        claims(MOST_ENTRIES).unwrap();
        let refused = claims(MOST_ENTRIES + 1).unwrap_err().to_string();
        assert!(refused.contains("more than 65,536 entries"), "{refused}");
    }
}
