//! Atomic writes: a file is there whole or not at all.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::{FileError, fault};

static NUMBER: AtomicU64 = AtomicU64::new(0);

/// Longest part of a name that is kept in the name of the file aside: file systems take 255 bytes in all.
const STEM: usize = 200;

/// A name that no other writer of this folder uses, in this process or another one. A long stem is cut.
pub fn unique_name(stem: &str) -> String {
    let end = (0..=stem.len().min(STEM)).rev().find(|&i| stem.is_char_boundary(i)).unwrap_or(0);
    format!("{}.{}.{}", &stem[..end], std::process::id(), NUMBER.fetch_add(1, Ordering::Relaxed))
}

/// A new file in `folder`: never one that is there already, whoever put it there.
fn create_aside(folder: &Path, stem: &str) -> io::Result<(PathBuf, File)> {
    create_aside_with(folder, stem, &mut OpenOptions::new())
}

/// The same, with options of the caller's.
fn create_aside_with(folder: &Path, stem: &str, options: &mut OpenOptions) -> io::Result<(PathBuf, File)> {
    loop {
        let path = folder.join(unique_name(stem));
        match options.write(true).create_new(true).open(&path) {
            Ok(file) => return Ok((path, file)),
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
            Err(e) => return Err(e),
        }
    }
}

/// The folder that a path lies in.
fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn write_parts(file: &mut File, path: &Path, parts: &[&[u8]]) -> Result<(), FileError> {
    let written = parts.iter().try_for_each(|part| file.write_all(part));
    written.map_err(|e| FileError::new("write", path, e))
}

/// Writes a file so that a crash, a kill or a power cut leaves the old one or the new one, never a torn one:
/// aside in the same folder, synced, renamed, the folder synced. Creates the folder.
///
/// ```
/// let folder = tempfile::tempdir().unwrap();
/// let path = folder.path().join("deep/checkpoint.bin");
/// segwild_files::write_atomic(&path, b"step 500").unwrap();
/// assert_eq!(std::fs::read(&path).unwrap(), b"step 500");
/// ```
///
/// # Errors
/// In words: disk full, read-only, denied.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    write_aside(folder_of(path), path, &[bytes])
}

/// Writes a new file that only its owner may read, such as a secret: after a kill it is there whole or not at all.
///
/// # Errors
/// Also when there is a file of that name.
pub fn write_private(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let failed = |e| FileError::new("write", path, e);
    let mut options = OpenOptions::new();
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let folder = folder_of(path);
    let stem = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let (temporary, mut file) =
        create_aside_with(folder, &format!(".{stem}"), &mut options).map_err(failed)?;
    let written =
        file.write_all(bytes).and_then(|()| file.sync_all()).and_then(|()| name_new(&temporary, path));
    // It has its name, or is only litter.
    let _ = fs::remove_file(&temporary);
    written.map_err(failed)?;
    sync_folder(folder)
}

/// Gives a file its name, never that of one that is there already.
fn name_new(temporary: &Path, path: &Path) -> io::Result<()> {
    match fs::hard_link(temporary, path) {
        // A file system without links.
        Err(e) if e.kind() != io::ErrorKind::AlreadyExists && fs::symlink_metadata(path).is_err() => {
            fs::rename(temporary, path)
        }
        linked => linked,
    }
}

/// As [`write_atomic`], for callers that name the file in an error of their own.
///
/// # Errors
/// The system's.
pub fn write_plain(path: impl AsRef<Path>, bytes: impl AsRef<[u8]>) -> io::Result<()> {
    write_atomic(path.as_ref(), bytes.as_ref()).map_err(|e| e.source)
}

/// As [`write_atomic`], from parts, by way of a file in `aside`, which must be on the same file system.
///
/// # Errors
/// As [`write_atomic`].
pub fn write_aside(aside: &Path, path: &Path, parts: &[&[u8]]) -> Result<(), FileError> {
    write_aside_with(aside, path, |file| write_parts(file, path, parts))
}

/// As [`write_atomic`], of bytes that arrive bit by bit: `fill` writes them into a file aside, which takes the name only
/// when `fill` has succeeded. What `fill` refuses never appears.
///
/// ```
/// use segwild_files::{FileError, write_with};
/// use std::io::Write;
/// let folder = tempfile::tempdir().unwrap();
/// let path = folder.path().join("model.bin");
/// let refused = write_with(&path, |file| {
///     file.write_all(b"half").and(Err(std::io::Error::other("the rest is missing"))).map_err(|e| FileError::new("read", &path, e))
/// });
/// assert!(refused.is_err() && std::fs::read_dir(folder.path()).unwrap().next().is_none());
/// ```
///
/// # Errors
/// Those of `fill`, and as [`write_atomic`].
pub fn write_with<E: From<FileError>>(
    path: &Path,
    fill: impl FnOnce(&mut File) -> Result<(), E>,
) -> Result<(), E> {
    write_aside_with(folder_of(path), path, fill)
}

/// As [`write_with`], by way of a file in `aside`, which must be on the same file system.
///
/// # Errors
/// As [`write_with`].
pub fn write_aside_with<E: From<FileError>>(
    aside: &Path,
    path: &Path,
    fill: impl FnOnce(&mut File) -> Result<(), E>,
) -> Result<(), E> {
    let folder = folder_of(path);
    for wanted in [aside, folder] {
        fs::create_dir_all(wanted).map_err(|e| FileError::new("create the folder", wanted, e))?;
    }
    let failed = |e| FileError::new("write", path, e);
    let stem = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    fault::point("file.write").map_err(failed)?;
    let (temporary, mut file) = create_aside(aside, &format!(".{stem}")).map_err(failed)?;
    let write = || -> Result<(), E> {
        fill(&mut file)?;
        file.sync_all().map_err(failed)?;
        fault::point("file.rename").map_err(failed)?;
        Ok(fs::rename(&temporary, path).map_err(failed)?)
    };
    write().inspect_err(|_| {
        // The error that matters is the first one; what is left aside is only litter.
        let _ = fs::remove_file(&temporary);
    })?;
    Ok(sync_folder(folder)?)
}

/// As [`write_atomic`], for a file that another program writes: `fill` is given an empty folder aside, and writes the file there
/// under the name that it has in the end. What else it leaves there is removed.
///
/// ```
/// use segwild_files::{FileError, write_by_folder};
/// let folder = tempfile::tempdir().unwrap();
/// let video = folder.path().join("statue.mp4");
/// let written: Result<(), FileError> = write_by_folder(&video, |aside| {
///     std::fs::write(aside.join("frame.png"), b"a part").unwrap();
///     std::fs::write(aside.join("statue.mp4"), b"whole").unwrap();
///     Ok(())
/// });
/// assert!(written.is_ok() && std::fs::read(&video).unwrap() == b"whole");
/// assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
/// ```
///
/// # Errors
/// Those of `fill`, and as [`write_atomic`]; also when `fill` wrote no such file.
pub fn write_by_folder<E: From<FileError>>(
    path: &Path,
    fill: impl FnOnce(&Path) -> Result<(), E>,
) -> Result<(), E> {
    let folder = folder_of(path);
    let name = path.file_name().unwrap_or_default();
    let aside = folder.join(unique_name(&format!(".{}", name.to_string_lossy())));
    fs::create_dir_all(&aside).map_err(|e| FileError::new("create the folder", &aside, e))?;
    let failed = |e| FileError::new("write", path, e);
    let done = fill(&aside).and_then(|()| {
        let written = aside.join(name);
        File::open(&written).and_then(|file| file.sync_all()).map_err(failed)?;
        fault::point("file.rename").map_err(failed)?;
        fs::rename(&written, path).map_err(failed)?;
        Ok(sync_folder(folder)?)
    });
    // What is left aside is only litter.
    let _ = fs::remove_dir_all(&aside);
    done
}

/// Opens a file to add to its end; it is made, with its folder, if it is not there.
///
/// # Errors
/// In words: disk full, read-only, denied.
pub fn open_to_append(path: &Path) -> Result<File, FileError> {
    let folder = folder_of(path);
    fs::create_dir_all(folder).map_err(|e| FileError::new("create the folder", folder, e))?;
    fault::point("file.append").map_err(|e| FileError::new("write", path, e))?;
    OpenOptions::new().create(true).append(true).open(path).map_err(|e| FileError::new("write", path, e))
}

/// Adds lines to the end of a file. A kill may cut the last one short: readers skip such a line.
///
/// # Errors
/// In words: disk full, read-only, denied.
pub fn append_line(path: &Path, lines: &str) -> Result<(), FileError> {
    let text = format!("{lines}\n");
    open_to_append(path)?.write_all(text.as_bytes()).map_err(|e| FileError::new("write", path, e))
}

/// Makes a folder that is there whole or not at all: `fill` writes into a folder aside, whose path it is given. That folder
/// then replaces the one that was there before. Where the system cannot exchange two folders at once, a kill
/// between two renames may leave neither in its place.
///
/// ```
/// use segwild_files::{self as files, FileError};
/// let dir = tempfile::tempdir().unwrap();
/// let statue = dir.path().join("statue");
/// for text in ["first", "second"] {
///     let written = files::write_folder::<FileError>(&statue, |aside| {
///         files::write_atomic(&aside.join("prompts.json"), text.as_bytes())
///     });
///     assert!(written.is_ok());
/// }
/// assert_eq!(std::fs::read(statue.join("prompts.json")).unwrap(), b"second");
/// assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
/// ```
///
/// # Errors
/// Those of `fill`, and in words: disk full, read-only, denied.
pub fn write_folder<E: From<FileError>>(
    path: &Path,
    fill: impl FnOnce(&Path) -> Result<(), E>,
) -> Result<(), E> {
    let parent = folder_of(path);
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let aside = parent.join(unique_name(&format!(".{name}")));
    fs::create_dir_all(&aside).map_err(|e| FileError::new("create the folder", &aside, e))?;
    let done = fill(&aside).and_then(|()| {
        sync_folder(&aside)?;
        replace_folder(&aside, path).map_err(|e| FileError::new("write", path, e))?;
        Ok(sync_folder(parent)?)
    });
    // After an exchange the old folder lies aside; after an error what there is of the new one: litter either way.
    let _ = fs::remove_dir_all(&aside);
    done
}

/// Puts a folder in the place of another one, which then lies in the first one's, or is gone.
fn replace_folder(new: &Path, path: &Path) -> io::Result<()> {
    if !path.exists() {
        return fs::rename(new, path);
    }
    #[cfg(target_os = "linux")]
    {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        // Not every file system can; the way below serves where it cannot.
        if renameat_with(CWD, new, CWD, path, RenameFlags::EXCHANGE).is_ok() {
            return Ok(());
        }
    }
    fs::remove_dir_all(path)?;
    fs::rename(new, path)
}

/// Removes the files and folders that writers of this module left aside in a folder when they were killed; those of processes that
/// still run stay. What cannot be removed is left: it is only litter. Does nothing where the system does not list
/// its running processes.
pub fn remove_litter(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    if !Path::new("/proc/self").exists() {
        return;
    }
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let mut parts = name.rsplit('.');
        let number = parts.next().and_then(|part| part.parse::<u64>().ok());
        let writer = parts.next().and_then(|part| part.parse::<u32>().ok());
        if let (true, Some(_), Some(writer)) = (name.starts_with('.'), number, writer)
            && !Path::new("/proc").join(writer.to_string()).exists()
        {
            let path = entry.path();
            let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        }
    }
}

/// Makes a rename in a folder last through a power cut.
///
/// # Errors
/// In words.
pub fn sync_folder(folder: &Path) -> Result<(), FileError> {
    if cfg!(unix) {
        File::open(folder).and_then(|f| f.sync_all()).map_err(|e| FileError::new("sync", folder, e))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Obstacle;

    #[test]
    fn a_file_of_the_users_named_part_stays() {
        let folder = tempfile::tempdir().unwrap();
        let (theirs, ours) = (folder.path().join("scene.ply.part"), folder.path().join("scene.ply"));
        fs::write(&theirs, "mine").unwrap();
        write_atomic(&ours, b"ply").unwrap();
        assert_eq!(fs::read(&theirs).unwrap(), b"mine");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }

    #[test]
    fn a_name_as_long_as_the_file_system_takes_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let name = "\u{e9}".repeat(127);
        write_atomic(&folder.path().join(&name), b"x").unwrap();
        let error = write_atomic(&folder.path().join("n".repeat(256)), b"x").unwrap_err();
        assert_eq!(error.obstacle, Obstacle::NameTooLong, "{error}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn a_link_that_lies_where_a_file_is_written_aside_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let outside = folder.path().join("outside");
        fs::write(&outside, "theirs").unwrap();
        let target = folder.path().join("model.bin");
        // The next thousand names that this process would use aside, whatever other tests write meanwhile.
        let next: u64 = unique_name("").rsplit('.').next().unwrap().parse().unwrap();
        for n in next..next + 1000 {
            let name = format!(".model.bin.{}.{n}", std::process::id());
            std::os::unix::fs::symlink(&outside, folder.path().join(name)).unwrap();
        }
        write_atomic(&target, b"ours").unwrap();
        assert_eq!(
            (fs::read(&outside).unwrap(), fs::read(&target).unwrap()),
            (b"theirs".into(), b"ours".into())
        );
    }

    #[test]
    fn a_full_disk_is_named() {
        // Linux has a device that is always full.
        let path = Path::new("/dev/full");
        let Ok(mut device) = File::options().write(true).open(path) else {
            eprintln!("skipped: a_full_disk_is_named: no /dev/full");
            return;
        };
        let error = write_parts(&mut device, path, &[b"x"]).unwrap_err();
        assert_eq!(error.obstacle, Obstacle::DiskFull);
        assert_eq!(
            error.to_string(),
            "cannot write /dev/full: the disk is full; free some space and run again"
        );
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_litter() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("target");
        fs::create_dir_all(target.join("occupied")).unwrap();
        // A folder that is not empty cannot be replaced by a file.
        assert!(write_atomic(&target, b"new").is_err());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_secret_that_is_there_stays_and_nothing_is_left_aside() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        write_private(&path, b"first").unwrap();
        assert!(write_private(&path, b"second").is_err());
        assert_eq!(fs::read(&path).unwrap(), b"first");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        #[cfg(unix)]
        assert_eq!(std::os::unix::fs::MetadataExt::mode(&fs::metadata(&path).unwrap()) & 0o777, 0o600);
    }

    #[test]
    fn only_the_litter_of_the_dead_goes() {
        let folder = tempfile::tempdir().unwrap();
        // Process numbers end at 2^22 on Linux.
        let dead = ".model.bin.4194999.3".to_owned();
        let kept =
            [format!(".model.bin.{}.3", std::process::id()), ".hidden".into(), "model.bin.4194999.3".into()];
        for name in kept.iter().chain([&dead]) {
            fs::write(folder.path().join(name), "x").unwrap();
        }
        let half = folder.path().join(".statue.4194999.7");
        fs::create_dir_all(half.join("masks")).unwrap();
        remove_litter(folder.path());
        assert_eq!(half.exists(), !Path::new("/proc/self").exists());
        assert!(kept.iter().all(|name| folder.path().join(name).exists()));
        assert_eq!(folder.path().join(dead).exists(), !Path::new("/proc/self").exists());
    }

    #[test]
    fn a_folder_that_is_a_file_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        write_atomic(&file, b"x").unwrap();
        assert!(write_atomic(&file.join("below"), b"y").is_err());
        assert_eq!(fs::read(&file).unwrap(), b"x");
    }
}
