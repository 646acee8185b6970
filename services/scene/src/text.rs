//! Text files as other programs and editors write them: byte order marks, UTF-16, Latin-1.

use crate::SceneError;
use crate::bytes::read_bytes;
use std::path::Path;

/// Why the bytes of a file are not taken for text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TextError {
    /// They are UTF-16, as Notepad and PowerShell write it.
    #[error("the file is UTF-16; save it as UTF-8 (in Windows PowerShell: `Out-File -Encoding utf8`)")]
    Utf16,
}

/// Reads a text file; see [`decode`] for what counts as text.
///
/// # Errors
/// The system refuses the file, or it is UTF-16.
pub fn read(path: &Path) -> Result<String, SceneError> {
    let bytes = read_bytes(path).map_err(SceneError::io(path))?;
    decode(bytes).map_err(|reason| SceneError::invalid(path, "text", reason))
}

/// Text from the bytes of a file: UTF-8 with or without a byte order mark, which is taken off. A line that is not UTF-8 is taken
/// as Latin-1, as old Windows programs write names.
///
/// # Errors
/// The bytes are UTF-16.
pub fn decode(bytes: Vec<u8>) -> Result<String, TextError> {
    let sixteen = match bytes[..] {
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => true,
        // Without a mark: every other byte of plain words is zero.
        [a, b, c, d, ..] => (a == 0) != (b == 0) && (a == 0) == (c == 0) && (b == 0) == (d == 0),
        _ => false,
    };
    if sixteen {
        return Err(TextError::Utf16);
    }
    let text = match bytes.strip_prefix(b"\xef\xbb\xbf") {
        Some(rest) => rest.to_vec(),
        None => bytes,
    };
    match String::from_utf8(text) {
        Ok(text) => Ok(text),
        Err(error) => Ok(error.as_bytes().split_inclusive(|&b| b == b'\n').map(line).collect()),
    }
}

/// One name or line: UTF-8, or else Latin-1.
pub(crate) fn line(bytes: &[u8]) -> String {
    match std::str::from_utf8(bytes) {
        Ok(text) => text.to_owned(),
        Err(_) => bytes.iter().map(|&b| char::from(b)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_read_as_windows_programs_write_it() {
        let read = |bytes: &[u8]| decode(bytes.to_vec());
        assert_eq!(read(b"\xef\xbb\xbf# a\r\n1 2\r\n").unwrap(), "# a\r\n1 2\r\n");
        assert_eq!(read("Straße\n".as_bytes()).unwrap(), "Straße\n");
        // One line of Latin-1 does not change the others.
        assert_eq!(read(b"Stra\xdfe\nStra\xc3\x9fe\n").unwrap(), "Straße\nStraße\n");
        for utf16 in [&b"\xff\xfe1\0"[..], b"\xfe\xff\x001", b"1\x002\0"] {
            assert!(read(utf16).unwrap_err().to_string().contains("UTF-16"), "{utf16:?}");
        }
        assert_eq!(read(b"").unwrap(), "");
    }
}
