//! Runs to and from a store: a copy that is consistent while the run goes on.

use std::io::Read;
use std::path::{Path, PathBuf};

use segwild_flow::files::{self, stays_inside};
use segwild_flow::process::{Lock, LockError};
use segwild_flow::{FileError, Ledger};

use super::digest::ArtefactDigest;
use super::error::{ArtefactError, FetchedFolderError};
use super::manifest::FolderEntry;
use super::session::{ArtefactSession, Gone};
use super::walk::{self, FoundFile};

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
/// COLMAP's database and log, which it may be writing: without them its features are computed again, and its models stay.
const OF_COLMAP: &str = "poses/colmap.";
/// How often a ledger is copied of which a checkpoint is removed meanwhile.
const TRIES: usize = 8;

/// Whether a path of a run folder, a file's or a folder's, goes with the run. The ledger goes as a copy; its log, the lock
/// and what is still being written belong to a process.
fn goes_with_run(path: &str) -> bool {
    let of_a_process = |part: &str| part.starts_with('.') || part.ends_with(".lock");
    !path.starts_with(LEDGER)
        && !path.starts_with(OF_COLMAP)
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
fn copy_of_growing(found: &FoundFile, to: PathBuf) -> Result<FoundFile, ArtefactError> {
    let failed = |e| FileError::new("read", &found.source, e);
    let file = files::open_plain(&found.source).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    files::write_with(&to, |copy| {
        std::io::copy(&mut file.take(length), copy).map(|_| ()).map_err(|e| FileError::new("copy", &to, e))
    })?;
    Ok(FoundFile { path: found.path.clone(), source: to })
}

/// A copy of the ledger, and the checkpoints that it names with their digests. Those that are there are held before the
/// copy is made: it takes longer than some checkpoints live. One that is written and removed meanwhile costs another copy.
fn held_ledger(
    ledger: &Ledger,
    run: &Path,
    aside: &Aside,
) -> Result<(FoundFile, Vec<(FoundFile, ArtefactDigest)>), ArtefactError> {
    let mut tries = 1;
    loop {
        let links = aside.0.join(format!("checkpoints{tries}"));
        std::fs::create_dir(&links).map_err(|e| FileError::new("create the folder", &links, e))?;
        let folder = run.join(CHECKPOINTS);
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            hold_file(&entry.path(), &links.join(entry.file_name()));
        }
        let copy = aside.0.join(format!("ledger{tries}"));
        ledger.copy_to(&copy)?;
        let rows = Ledger::open_read_only(&copy)?.all_checkpoints(TRAINING)?;
        let (mut held, mut missing) = (Vec::new(), None);
        for row in rows {
            // Of others the run reports that the ledger names a file elsewhere.
            let (true, Ok(digest)) = (files::name::is_plain(&row.file), row.digest.parse()) else { continue };
            let path = format!("{CHECKPOINTS}/{}", row.file);
            match hold_file(&folder.join(&row.file), &links.join(&row.file)) {
                Some(source) => held.push((FoundFile { path, source }, digest)),
                None => missing = Some(path),
            }
        }
        if let Some(path) = missing.as_ref().filter(|_| tries == TRIES) {
            // The run passes over it, and names it.
            tracing::warn!("{}: its ledger names a checkpoint that is not there: {path}", run.display());
        }
        if missing.is_none() || tries == TRIES {
            return Ok((FoundFile { path: LEDGER.into(), source: copy }, held));
        }
        tries += 1;
    }
}

/// A second name of a file, made unless it is there, under which it stays when the first one is removed; the file itself
/// where the file system has no links; `None` when it is gone.
fn hold_file(file: &Path, link: &Path) -> Option<PathBuf> {
    if link.is_file() || std::fs::hard_link(file, link).is_ok() {
        return Some(link.to_owned());
    }
    file.is_file().then(|| file.to_owned())
}

impl ArtefactSession {
    /// Stores a run as it is now, also while its process goes on. First the ledger is copied, then the files: each was
    /// whole before the ledger named it. The checkpoints that the ledger names are held by links meanwhile, so that they
    /// outlive their removal for newer ones; only where one goes in the moment before that, the ledger is copied again.
    ///
    /// # Errors
    /// When there is no run, something in the folder leads out of it, or the store cannot be reached.
    pub fn store_run(&self, run: &Path) -> Result<ArtefactDigest, ArtefactError> {
        stays_inside(run, |_| true)?;
        let ledger = Ledger::open_read_only(run.join(LEDGER))?;
        let aside = Aside::make(run)?;
        let (copy, checkpoints) = held_ledger(&ledger, run, &aside)?;
        let mut found = walk::files(run, self.limits(), &goes_with_run)?;
        found.retain(|file| !checkpoints.iter().any(|(held, _)| held.path == file.path));
        for (i, file) in found.iter_mut().enumerate().filter(|(_, file)| grows(&file.path)) {
            *file = copy_of_growing(file, aside.0.join(format!("growing{i}")))?;
        }
        found.push(copy);
        let mut entries = self.store_files(&found, Gone::LeftOut)?;
        for (held, digest) in checkpoints {
            match self.put(&digest, &held.source) {
                Ok(()) => {
                    // The file may have been damaged after the store got it: the length is that of what the store has.
                    let bytes = match self.store().find(&digest)? {
                        Some(stored) => stored.bytes,
                        None => {
                            let data = std::fs::metadata(&held.source);
                            data.map_err(|e| FileError::new("read", &held.source, e))?.len()
                        }
                    };
                    entries.push(FolderEntry { path: held.path, digest, bytes });
                }
                // The run passes over a damaged checkpoint, and names it.
                Err(ArtefactError::Changed { .. }) => {
                    tracing::warn!(
                        "{}: the checkpoint {} is damaged: it is left out",
                        run.display(),
                        held.path
                    );
                }
                Err(error) => return Err(error),
            }
        }
        // On the disk of the run: if that one is full, the error names it.
        self.store_manifest(run, entries, &aside.0)
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
        let [ledger] = ledger[..] else { return Err(refused(FetchedFolderError::NoLedger)) };
        if let Some(entry) = others.iter().find(|entry| !goes_with_run(&entry.path)) {
            let path = files::name::one_line(&entry.path).into_owned();
            return Err(refused(FetchedFolderError::OtherFile(path)));
        }
        let others: Vec<FolderEntry> = others.into_iter().cloned().collect();
        self.fetch_files(&others, into)?;
        // The right bytes may yet be no ledger.
        let fetched = into.join(files::unique_name(".ledger"));
        self.store().get(&ledger.digest, ledger.bytes..=ledger.bytes, &fetched)?;
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
