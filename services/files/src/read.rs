//! Reading files that others supply: only plain files; nothing here ever waits for a pipe or a device.

use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result};
use std::path::Path;

/// Opens a file for reading. A pipe, a device, a socket or a folder in its place is refused at once. The check is made on the
/// opened handle, so it holds even if the name was replaced a moment ago; opening does not wait for a writer.
///
/// # Errors
/// When the system refuses, or it is no plain file.
pub fn open_plain(path: &Path) -> Result<File> {
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

/// Most bytes of a file that is read whole where nothing says how many it may have; a file of holes may claim anything.
const MOST: u64 = 2 << 30;

/// All bytes of a file, which is opened as by [`open_plain`].
///
/// # Errors
/// When the system refuses, it is no plain file, or it has more than 2 GiB.
pub fn read_plain(path: &Path) -> Result<Vec<u8>> {
    read_within(path, MOST)
}

/// The same of at most so many bytes.
///
/// # Errors
/// When the system refuses, it is no plain file, or it has more.
pub fn read_within(path: &Path, most: u64) -> Result<Vec<u8>> {
    let (file, _) = open_within(path, most)?;
    let mut bytes = Vec::new();
    file.take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most { Err(too_large(most)) } else { Ok(bytes) }
}

/// Opens a file as by [`open_plain`], to be read bit by bit; with its length, at most so many bytes.
///
/// # Errors
/// As [`read_within`].
pub fn open_within(path: &Path, most: u64) -> Result<(File, u64)> {
    let file = open_plain(path)?;
    let bytes = file.metadata()?.len();
    if bytes > most { Err(too_large(most)) } else { Ok((file, bytes)) }
}

fn too_large(most: u64) -> Error {
    Error::new(
        ErrorKind::FileTooLarge,
        format!("it has more than {} MiB, which no such file has", most >> 20),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_read_whole_and_a_missing_one_is_reported_as_missing() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("model.bin");
        assert_eq!(read_plain(&file).unwrap_err().kind(), ErrorKind::NotFound);
        std::fs::write(&file, b"splats").unwrap();
        assert_eq!(read_plain(&file).unwrap(), b"splats");
        let message = read_plain(folder.path()).unwrap_err().to_string();
        assert!(message.contains("it is a folder"), "{message}");
    }

    #[test]
    fn a_file_of_holes_that_claims_20_gib_is_refused_before_memory_is_taken() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("model.bin");
        let Ok(()) = File::create(&file).unwrap().set_len(20 << 30) else {
            return println!("skipped: a_file_of_holes_that_claims_20_gib: this file system has no holes");
        };
        assert_eq!(read_plain(&file).unwrap_err().kind(), ErrorKind::FileTooLarge);
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_that_nobody_writes_to_and_an_endless_device_are_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let (pipe, endless) = (folder.path().join("model.bin"), folder.path().join("features.bin"));
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().unwrap();
        assert!(made.success());
        std::os::unix::fs::symlink("/dev/zero", &endless).unwrap();
        for file in [pipe, endless] {
            let message = read_plain(&file).unwrap_err().to_string();
            assert!(message.contains("a pipe, a device or a socket"), "{message}");
        }
    }
}
