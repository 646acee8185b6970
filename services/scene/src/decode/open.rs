//! Opening files that others supply: only plain files, and never waiting for what is none.

use std::fs::File;
use std::io::{Error, ErrorKind, Read};
use std::path::Path;

/// Opens a file for reading. A pipe, a device, a socket or a folder in its place is refused at once, whatever the name meant a
/// moment ago: what was opened is looked at, and opening does not wait for a writer.
///
/// # Errors
/// When the system refuses, or it is no plain file.
pub fn open_file(path: &Path) -> std::io::Result<File> {
    let mut options = File::options();
    options.read(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, rustix::fs::OFlags::NONBLOCK.bits() as i32);
    let file = options.open(path)?;
    let kind = file.metadata()?.file_type();
    if kind.is_file() {
        return Ok(file);
    }
    let what = if kind.is_dir() { "a folder" } else { "a pipe, a device or a socket" };
    Err(Error::new(ErrorKind::InvalidInput, format!("it is {what}, not a file")))
}

/// All bytes of a file.
pub(crate) fn read_bytes(path: &Path) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open_file(path)?.read_to_end(&mut bytes)?;
    Ok(bytes)
}
