//! Zip archives as they are sent: files that are stored as they are, in parts (PKWARE's APPNOTE, section 4.3). What is archived here is
//! compressed already.

use flate2::Crc;

/// Starts of a file, of its line in the list, and of the end.
const LOCAL: u32 = 0x0403_4b50;
const LISTED: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
/// Version that a reader needs: folders.
const VERSION: u16 = 20;
/// The flag of names in UTF-8.
const UTF_8: u16 = 1 << 11;
/// The first of January 1980: archives of the same files have the same bytes.
const DATE: u16 = 0x21;
/// Files of an archive at most.
pub(crate) const MOST_FILES: usize = u16::MAX as usize - 1;

/// What whoever wants a larger archive reads.
pub(crate) const FULL: &str = "an archive holds 4 GiB and 65,534 files at most: export one object at a time";

/// An archive holds 4 GiB and 65,534 files at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}", FULL)]
pub(crate) struct ArchiveIsFull;

/// Writes an archive part by part; only the list of its files stays in memory.
#[derive(Default)]
pub(crate) struct ZipWriter {
    listed: Vec<u8>,
    files: u16,
    /// Bytes that were written.
    at: u32,
}

impl ZipWriter {
    /// The part of a file. `name` is its path in the archive, with `/`.
    ///
    /// # Errors
    /// When the archive would be too large.
    pub fn file(&mut self, name: &str, bytes: &[u8]) -> Result<Vec<u8>, ArchiveIsFull> {
        let size = u32::try_from(bytes.len()).map_err(|_| ArchiveIsFull)?;
        let name_length = u16::try_from(name.len()).map_err(|_| ArchiveIsFull)?;
        if usize::from(self.files) >= MOST_FILES {
            return Err(ArchiveIsFull);
        }
        let mut crc = Crc::new();
        crc.update(bytes);
        // What a file and its line in the list have in common.
        let mut form = Vec::new();
        add_short(&mut form, &[VERSION, UTF_8, 0, 0, DATE]);
        add(&mut form, &[crc.sum(), size, size]);
        add_short(&mut form, &[name_length, 0]);
        let mut part = LOCAL.to_le_bytes().to_vec();
        part.extend(&form);
        part.extend(name.as_bytes());
        part.extend(bytes);
        let end = u32::try_from(part.len()).ok().and_then(|length| self.at.checked_add(length));
        let mut listed = LISTED.to_le_bytes().to_vec();
        add_short(&mut listed, &[VERSION]);
        listed.extend(&form);
        // No comment, one volume, no attributes.
        add_short(&mut listed, &[0, 0, 0]);
        add(&mut listed, &[0, self.at]);
        listed.extend(name.as_bytes());
        self.at = end.ok_or(ArchiveIsFull)?;
        self.listed.extend(listed);
        self.files += 1;
        Ok(part)
    }

    /// The last part: the list of the files.
    ///
    /// # Errors
    /// When the archive is too large.
    pub fn end(self) -> Result<Vec<u8>, ArchiveIsFull> {
        let ZipWriter { listed: mut part, files, at } = self;
        let size = u32::try_from(part.len()).map_err(|_| ArchiveIsFull)?;
        add(&mut part, &[END]);
        add_short(&mut part, &[0, 0, files, files]);
        add(&mut part, &[size, at]);
        add_short(&mut part, &[0]);
        Ok(part)
    }
}

fn add(bytes: &mut Vec<u8>, numbers: &[u32]) {
    bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
}

fn add_short(bytes: &mut Vec<u8>, numbers: &[u16]) {
    bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_archive_has_the_lengths_and_positions_of_the_format() {
        let mut zip = ZipWriter::default();
        let files: [(&str, &[u8]); 2] = [("a/b.png", b"123456789"), ("provenance.json", b"{}")];
        let parts = files.map(|(name, bytes)| zip.file(name, bytes).unwrap());
        assert_eq!(parts.each_ref().map(Vec::len), [30 + 7 + 9, 30 + 15 + 2]);
        // The check value of CRC-32.
        assert_eq!(parts[0][14..18], 0xcbf4_3926u32.to_le_bytes());
        assert!(parts[0].ends_with(b"a/b.png123456789"));
        let end = zip.end().unwrap();
        assert_eq!(end.len(), 2 * 46 + 7 + 15 + 22);
        let second = &end[46 + 7..];
        assert_eq!(second[42..46], 46u32.to_le_bytes(), "where the second file starts");
        assert_eq!(end[end.len() - 6..end.len() - 2], (46u32 + 47).to_le_bytes(), "where the list starts");
    }
}
