//! TIFFs: how many values the first directory claims. Their decoder allocates memory for all of them before it reads one.

use super::DecodeError;
use std::io::{Read, Seek, SeekFrom};

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

    /// Looks for an entry whose values take more than `most` bytes; its tag and how many it claims.
    fn too_many(&mut self, most: u64) -> Option<(u64, u64)> {
        let bytes = self.first_directory()?;
        for _ in 0..self.next(if bytes == 8 { 8 } else { 2 })? {
            let (tag, kind, count) = (self.next(2)?, self.next(2)?, self.next(bytes)?);
            self.next(bytes)?;
            if count.saturating_mul(size_of(kind as u16)) > most {
                return Some((tag, count));
            }
        }
        None
    }
}

/// Refuses a file of `length` bytes whose first directory claims more values than these can hold.
pub(crate) fn check_counts(file: impl Read + Seek, length: u64) -> Result<(), DecodeError> {
    match (TiffReader { file, big_endian: false }).too_many(length) {
        None => Ok(()),
        Some((tag, count)) => Err(DecodeError::TiffCount { tag, count, bytes: length }),
    }
}
