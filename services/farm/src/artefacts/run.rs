//! Runs to and from a store: a copy that is consistent while the run goes on.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use segwild_flow::files::{self, stays_inside};
use segwild_flow::ledger::CheckpointRow;
use segwild_flow::process::{Lock, LockError};
use segwild_flow::{FileError, Ledger};

use super::digest::ArtefactDigest;
use super::error::ArtefactError;
use super::manifest::FolderEntry;
use super::session::{ArtefactSession, Gone};
use super::walk::{self, Found};

/// The ledger's name in a run folder. It lies on a local disk: what is copied is never the file that SQLite works on.
const LEDGER: &str = "run.sqlite";
/// What SQLite keeps beside a ledger that is open.
const BESIDE_LEDGER: [&str; 3] = ["run.sqlite-wal", "run.sqlite-shm", "run.sqlite-journal"];
/// The lock of who writes the run.
const LOCK: &str = "run.lock";
/// The stages that keep checkpoints.
const TRAINING: &str = "geometry";
/// The folder of its checkpoints.
const CHECKPOINTS: &str = "checkpoints";
/// How often a run is copied in which files of the ledger are removed meanwhile.
const TRIES: usize = 3;

/// Whether a path of a run folder, a file's or a folder's, goes with the run. The ledger goes as a copy; its log, the lock
/// and what is still being written belong to a process.
fn goes_with_run(path: &str) -> bool {
    let of_a_process = |part: &str| part.starts_with('.') || part.ends_with(".lock");
    !path.starts_with(LEDGER)
        && !path.split('/').any(of_a_process)
        && !["cache/tmp", "cache/corrupt"].iter().any(|aside| {
            path.strip_prefix(aside).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
        })
}

/// Whether a file grows at its end while the run goes on.
fn grows(path: &str) -> bool {
    path.ends_with(".jsonl")
}

/// A folder for copies, removed at the end.
struct Aside(PathBuf);

impl Aside {
    fn make(run: &Path) -> Result<Self, FileError> {
        let path = run.join(files::unique_name(".copies"));
        std::fs::create_dir(&path).map_err(|e| FileError::new("create the folder", &path, e))?;
        Ok(Self(path))
    }
}

impl Drop for Aside {
    fn drop(&mut self) {
        // The next run removes what is left of a dead process.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Copies a file that grows, as long as it is now.
fn copy_of_growing(found: &Found, to: PathBuf) -> Result<Found, ArtefactError> {
    let failed = |e| FileError::new("read", &found.source, e);
    let file = File::open(&found.source).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    files::write_with(&to, |copy| {
        std::io::copy(&mut file.take(length), copy).map(|_| ()).map_err(|e| FileError::new("copy", &to, e))
    })?;
    Ok(Found { path: found.path.clone(), source: to })
}

impl ArtefactSession {
    /// Stores a run as it is now, also while its process goes on. First the ledger is copied, then the files: each was
    /// whole before the ledger named it. A checkpoint may be removed meanwhile for newer ones: then all is done once more.
    ///
    /// # Errors
    /// When there is no run, something in the folder leads out of it, or the store cannot be reached.
    pub fn store_run(&self, run: &Path) -> Result<ArtefactDigest, ArtefactError> {
        stays_inside(run, |_| true)?;
        let mut tries = 1;
        loop {
            let (entries, missing) = self.store_run_once(run)?;
            match missing {
                Some(row) if tries < TRIES => {
                    tracing::debug!(
                        "checkpoint {} was removed while the run was stored: once more",
                        row.file
                    );
                }
                Some(row) => {
                    // The run passes over it, and names it.
                    tracing::warn!(
                        "{}: its ledger names a checkpoint that is not there: {}",
                        run.display(),
                        row.file
                    );
                    return self.store_manifest(run, entries);
                }
                None => return self.store_manifest(run, entries),
            }
            tries += 1;
        }
    }

    /// The files of the run, and a checkpoint that its ledger names and that was not found.
    fn store_run_once(&self, run: &Path) -> Result<(Vec<FolderEntry>, Option<CheckpointRow>), ArtefactError> {
        let ledger = Ledger::open_read_only(run.join(LEDGER))?;
        let aside = Aside::make(run)?;
        let copy = Found { path: LEDGER.into(), source: aside.0.join("ledger") };
        ledger.copy_to(&copy.source)?;
        let checkpoints = Ledger::open_read_only(&copy.source)?.all_checkpoints(TRAINING)?;
        let mut found = walk::files(run, self.limits(), &goes_with_run)?;
        for (i, file) in found.iter_mut().enumerate().filter(|(_, file)| grows(&file.path)) {
            *file = copy_of_growing(file, aside.0.join(format!("growing{i}")))?;
        }
        found.push(copy);
        let entries = self.store_files(&found, Gone::LeftOut)?;
        let stored: HashMap<&str, &FolderEntry> =
            entries.iter().map(|entry| (entry.path.as_str(), entry)).collect();
        let is_missing = |row: &CheckpointRow| {
            let entry = stored.get(format!("{CHECKPOINTS}/{}", row.file).as_str()).copied();
            entry.is_none_or(|entry| entry.digest.to_string() != row.digest)
        };
        let missing = checkpoints.into_iter().find(is_missing);
        Ok((entries, missing))
    }

    /// Fetches a run such that `segwild run` continues it in `into`. The ledger comes last: what is fetched in part is no
    /// run. Nobody owns the run that comes: who opens it next does.
    ///
    /// # Errors
    /// As [`ArtefactSession::fetch_folder`], and when a process uses the run in `into`, or the digest is none of a run.
    pub fn fetch_run(&self, digest: &ArtefactDigest, into: &Path) -> Result<(), ArtefactError> {
        std::fs::create_dir_all(into).map_err(|e| FileError::new("create the folder", into, e))?;
        stays_inside(into, |_| true)?;
        let _lock = Lock::take(&into.join(LOCK)).map_err(|error| match error {
            LockError::Held(owner) => ArtefactError::Busy { path: into.to_owned(), owner },
            LockError::File(error) => error.into(),
        })?;
        let manifest = self.fetch_manifest(digest, into)?;
        let refused = |reason| ArtefactError::Manifest { digest: *digest, reason };
        let (ledger, others): (Vec<&FolderEntry>, Vec<&FolderEntry>) =
            manifest.files().iter().partition(|entry| entry.path == LEDGER);
        let [ledger] = ledger[..] else { return Err(refused("it has no ledger: it is no run".into())) };
        if let Some(entry) = others.iter().find(|entry| !goes_with_run(&entry.path)) {
            let path = files::name::one_line(&entry.path).into_owned();
            return Err(refused(format!("`{path}` is no file of a run that goes to another machine")));
        }
        let others: Vec<FolderEntry> = others.into_iter().cloned().collect();
        self.fetch_files(&others, into)?;
        // The right bytes may yet be no ledger.
        let fetched = into.join(files::unique_name(".ledger"));
        self.store().get(&ledger.digest, &fetched)?;
        let done = Ledger::open_read_only(&fetched).map(|_| ()).map_err(ArtefactError::from);
        done.and_then(|()| replace_ledger(&fetched, into)).inspect_err(|_| {
            // The error that matters is the first one; what is left is only litter.
            let _ = std::fs::remove_file(&fetched);
        })
    }
}

/// Puts a ledger in the place of another one, whose log must not be merged into the new one.
fn replace_ledger(fetched: &Path, run: &Path) -> Result<(), ArtefactError> {
    for name in [LEDGER].iter().chain(&BESIDE_LEDGER) {
        let path = run.join(name);
        match std::fs::remove_file(&path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                return Err(FileError::new("remove", &path, e).into());
            }
            _ => {}
        }
    }
    let path = run.join(LEDGER);
    std::fs::rename(fetched, &path).map_err(|e| FileError::new("write", &path, e))?;
    Ok(files::sync_folder(run)?)
}
