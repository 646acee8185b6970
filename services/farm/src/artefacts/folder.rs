//! A shared folder's artefacts as files: what a client of object stores has no call for.
//!
//! ```text
//! FOLDER/ab/abcdef..                an artefact by its digest
//! FOLDER/ab/abcdef..#1              what somebody is storing, or was when their process died
//! FOLDER/ab/.swept-abcdef...        what a sweep is about to remove, or was when its process died
//! ```

use std::fs::{self, File};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use segwild_flow::FileError;
use segwild_flow::files::unique_name;

use super::digest::ArtefactDigest;

/// How the name of a file starts that a sweep is about to remove. The digest follows, and what no other removal has.
const SWEPT: &str = ".swept-";

/// Renews an artefact without its bytes; whether that was possible.
pub(super) fn touch(folder: &Path, digest: &ArtefactDigest) -> bool {
    let path = path_of(folder, digest);
    // Another user's file has a time that only that user sets. One that went meanwhile has none.
    let touched = File::open(&path).and_then(|file| file.set_modified(SystemTime::now()));
    // A removal that has renamed it reads its age only now: it comes back, or who called stores it again.
    touched.is_ok() && path.is_file()
}

/// Removes an artefact that is at least so old; whether it did. It is renamed first, and its age is read under a name that nobody
/// else opens: who renews it before that keeps it, and who does so after it does not find it.
pub(super) fn remove_older(
    folder: &Path,
    digest: &ArtefactDigest,
    least: Duration,
) -> Result<bool, FileError> {
    let path = path_of(folder, digest);
    if !is_older(&path, least).map_err(|e| FileError::new("read", &path, e))? {
        return Ok(false);
    }
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_nanos());
    // Two machines may have processes of one number.
    let swept = path.with_file_name(format!("{SWEPT}{digest}.{now}{}", unique_name("")));
    match fs::rename(&path, &swept) {
        Ok(()) => {}
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(false),
        Err(e) => return Err(FileError::new("remove", &path, e)),
    }
    let old = is_older(&swept, least).map_err(|e| FileError::new("read", &swept, e));
    if !matches!(old, Ok(true)) {
        put_back(&swept, &path)?;
        return old;
    }
    match fs::remove_file(&swept) {
        Ok(()) => Ok(true),
        // Another sweep has brought it back.
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(false),
        Err(e) => Err(FileError::new("remove", &swept, e)),
    }
}

/// Brings back what removals that were killed have renamed: it may have been renewed before that.
pub(super) fn bring_back(folder: &Path) -> Result<(), FileError> {
    for (path, name) in files_where(folder, |name| name.starts_with(SWEPT))? {
        let digest: Option<ArtefactDigest> =
            name.strip_prefix(SWEPT).and_then(|rest| rest.split('.').next()?.parse().ok());
        if let Some(digest) = digest {
            put_back(&path, &path_of(folder, &digest))?;
        }
    }
    Ok(())
}

/// Removes what interrupted transfers left and nobody has written for at least so long.
pub(super) fn remove_interrupted(folder: &Path, least: Duration) -> Result<(), FileError> {
    let of_a_transfer = |name: &str| {
        name.split_once('#').is_some_and(|(digest, number)| {
            digest.parse::<ArtefactDigest>().is_ok()
                && !number.is_empty()
                && number.bytes().all(|b| b.is_ascii_digit())
        })
    };
    for (path, _) in files_where(folder, of_a_transfer)? {
        if is_older(&path, least).map_err(|e| FileError::new("read", &path, e))? {
            gone(fs::remove_file(&path)).map_err(|e| FileError::new("remove", &path, e))?;
        }
    }
    Ok(())
}

fn path_of(folder: &Path, digest: &ArtefactDigest) -> PathBuf {
    let hex = digest.to_string();
    folder.join(&hex[..2]).join(&hex)
}

/// Whether a file is at least so old; one that is not there is not.
fn is_older(path: &Path, least: Duration) -> io::Result<bool> {
    let modified = match fs::metadata(path).and_then(|data| data.modified()) {
        Ok(modified) => modified,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(false),
        Err(e) => return Err(e),
    };
    // One whose time lies ahead, by another machine's clock, is new.
    Ok(SystemTime::now().duration_since(modified).unwrap_or_default() >= least)
}

/// Gives a renamed artefact its name again, unless somebody has stored it meanwhile: that one is younger.
fn put_back(swept: &Path, path: &Path) -> Result<(), FileError> {
    let linked = match fs::hard_link(swept, path) {
        Ok(()) => true,
        // Where the file system has no links, or lets only a file's owner make one.
        Err(_) => path.is_file(),
    };
    let done = if linked { fs::remove_file(swept) } else { fs::rename(swept, path) };
    // Another sweep may have done the same.
    gone(done).map_err(|e| FileError::new("rename", swept, e))
}

fn gone(done: io::Result<()>) -> io::Result<()> {
    match done {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(()),
        done => done,
    }
}

/// The files in the folders of artefacts whose names are wanted.
fn files_where(folder: &Path, wanted: impl Fn(&str) -> bool) -> Result<Vec<(PathBuf, String)>, FileError> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |e| FileError::new("list", &path, e)
    };
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).map_err(failed(folder))? {
        let inner = entry.map_err(failed(folder))?.path();
        let of_artefacts = inner
            .file_name()
            .and_then(|name| name.to_str())
            .is_some_and(|name| name.len() == 2 && name.bytes().all(|b| b.is_ascii_hexdigit()));
        if !of_artefacts || !inner.is_dir() {
            continue;
        }
        for entry in fs::read_dir(&inner).map_err(failed(&inner))? {
            let entry = entry.map_err(failed(&inner))?;
            let name = entry.file_name();
            if let Some(name) = name.to_str().filter(|name| wanted(name)) {
                found.push((entry.path(), name.to_owned()));
            }
        }
    }
    Ok(found)
}
