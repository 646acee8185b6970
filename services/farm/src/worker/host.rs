//! A worker's folder: scenes come from the farm's artefacts, and their state goes there.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use segwild_flow::{FileError, files, lock};

use super::scene::FarmScene;
use crate::artefacts::{ArtefactDigest, ArtefactError, ArtefactSession};
use crate::crew::{HostFailure, SceneHost};
use crate::engine::{ErrorClass, JobLease};
use crate::job::Job;
use crate::manifest::SceneJob;

/// ```text
/// WORK/inputs/DIGEST/          photos and cameras
/// WORK/runs/BATCH/SCENE/       run folders
/// WORK/stored/BATCH/SCENE      the artefact that a run folder was last stored as, or fetched from
/// WORK/removed/                what is being deleted
/// ```
pub(super) struct FarmHost {
    folder: PathBuf,
    artefacts: ArtefactSession,
    /// How many scenes use an input now.
    used: Mutex<BTreeMap<PathBuf, usize>>,
    /// What this process has stored or fetched, by scene: a full disk may not take the file.
    noted: Mutex<BTreeMap<String, String>>,
}

impl FarmHost {
    pub fn new(folder: &Path, artefacts: ArtefactSession) -> Self {
        // Made as long as there is space. Without it folders are deleted where they are.
        let _ = std::fs::create_dir_all(removed_in(folder));
        Self { folder: folder.to_owned(), artefacts, used: Mutex::default(), noted: Mutex::default() }
    }

    /// Puts a folder aside, to be deleted; returns whether there was one.
    fn put_aside(&self, folder: &Path) -> bool {
        if !folder.is_dir() {
            return false;
        }
        let aside = removed_in(&self.folder).join(files::unique_name("scene"));
        if std::fs::rename(folder, &aside).is_err() {
            delete(folder);
        }
        true
    }

    /// The artefact that a run folder continues.
    fn stored_file(&self, scene: &SceneJob) -> PathBuf {
        self.folder.join("stored").join(&scene.name)
    }

    /// Whether a run folder continues this artefact.
    fn continues(&self, scene: &SceneJob, artefact: &str) -> bool {
        match lock(&self.noted).get(&scene.name) {
            Some(noted) => noted == artefact,
            None => files::read_plain(&self.stored_file(scene)).is_ok_and(|have| have == artefact.as_bytes()),
        }
    }

    fn note_stored(&self, scene: &SceneJob, artefact: &str) -> Result<(), HostFailure> {
        lock(&self.noted).insert(scene.name.clone(), artefact.to_owned());
        let file = self.stored_file(scene);
        file.parent().map_or(Ok(()), std::fs::create_dir_all).map_err(|e| at("write", &file, e))?;
        files::write_atomic(&file, artefact.as_bytes()).map_err(HostFailure::passing)
    }
}

fn at(action: &'static str, path: &Path, error: std::io::Error) -> HostFailure {
    HostFailure::passing(FileError::new(action, path, error))
}

fn failure(error: ArtefactError) -> HostFailure {
    let class = match &error {
        ArtefactError::Manifest { .. } | ArtefactError::Unfit { .. } | ArtefactError::Long { .. } => {
            ErrorClass::Fatal
        }
        _ => ErrorClass::Retryable,
    };
    HostFailure { class, words: error.to_string() }
}

/// The folders in a folder; none where it is not there.
fn folders_in(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let folders = entries.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()));
    folders.map(|entry| entry.path()).collect()
}

/// Where folders are until they are deleted.
fn removed_in(folder: &Path) -> PathBuf {
    folder.join("removed")
}

/// Deletes what a scene left. What stays only takes space.
fn delete(folder: &Path) {
    if let Err(failure) = removed(folder) {
        tracing::warn!(%failure, "what a scene left cannot be removed");
    }
}

fn removed(folder: &Path) -> Result<(), HostFailure> {
    match std::fs::remove_dir_all(folder) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(at("remove", folder, error)),
        _ => Ok(()),
    }
}

impl SceneHost for FarmHost {
    fn scene(&self, job: &Job) -> Result<SceneJob, HostFailure> {
        let refused =
            |error: super::FarmSceneError| HostFailure { class: ErrorClass::Fatal, words: error.to_string() };
        let scene = FarmScene::of_job(job).map_err(refused)?;
        Ok(SceneJob {
            name: job.id.clone(),
            path: self.folder.join("inputs").join(scene.photos.to_string()),
            out: self.folder.join("runs").join(&job.id),
            settings: scene.settings,
            until: scene.until,
        })
    }

    fn is_remote(&self) -> bool {
        true
    }

    fn fetch(&self, lease: &JobLease, scene: &SceneJob) -> Result<(), HostFailure> {
        *lock(&self.used).entry(scene.path.clone()).or_default() += 1;
        let photos = FarmScene::of_job(&lease.job).map_err(HostFailure::passing)?.photos;
        self.artefacts.fetch_folder(&photos, &scene.path).map_err(failure)?;
        let Some(checkpoint) = &lease.checkpoint else { return Ok(()) };
        let artefact: ArtefactDigest =
            checkpoint.parse().map_err(|e| HostFailure::passing(format!("its checkpoint: {e}")))?;
        if self.continues(scene, checkpoint) && scene.out.is_dir() {
            // What this worker did after it stored that.
            return Ok(());
        }
        removed(&scene.out)?;
        self.artefacts.fetch_run(&artefact, &scene.out).map_err(failure)?;
        self.note_stored(scene, checkpoint)
    }

    fn store(&self, scene: &SceneJob) -> Result<Option<String>, HostFailure> {
        if !scene.out.join("run.sqlite").is_file() {
            return Ok(None);
        }
        let artefact = self.artefacts.store_run(&scene.out).map_err(failure)?.to_string();
        if let Err(failure) = self.note_stored(scene, &artefact) {
            // It is stored. A worker that is started again fetches it.
            tracing::warn!(%failure, "which artefact a run folder was stored as cannot be noted");
        }
        Ok(Some(artefact))
    }

    fn leave(&self, scene: &SceneJob, may_return: bool) -> bool {
        let mut used = lock(&self.used);
        let left = used.get(&scene.path).copied().unwrap_or_default().saturating_sub(1);
        match left {
            0 => drop(used.remove(&scene.path)),
            _ => drop(used.insert(scene.path.clone(), left)),
        }
        if may_return {
            return false;
        }
        lock(&self.noted).remove(&scene.name);
        // It may not be there.
        let _ = std::fs::remove_file(self.stored_file(scene));
        let run = self.put_aside(&scene.out);
        // While `used` is held, no other scene fetches the same photos into a folder that goes.
        let input = left == 0 && self.put_aside(&scene.path);
        run || input
    }

    fn reclaim(&self, here: &[&SceneJob]) -> bool {
        let used = lock(&self.used);
        let runs = self.folder.join("runs");
        let mut unwanted = folders_in(&self.folder.join("inputs"));
        unwanted.retain(|input| !used.contains_key(input));
        unwanted.extend(folders_in(&runs).iter().flat_map(|batch| folders_in(batch)));
        unwanted.retain(|folder| !here.iter().any(|scene| scene.path == *folder || scene.out == *folder));
        let mut found = false;
        for folder in unwanted {
            found |= self.put_aside(&folder);
            if let Ok(name) = folder.strip_prefix(&runs) {
                lock(&self.noted).remove(&*name.to_string_lossy());
                // It may not be there.
                let _ = std::fs::remove_file(self.folder.join("stored").join(name));
            }
        }
        found
    }

    fn clear(&self) {
        folders_in(&removed_in(&self.folder)).iter().for_each(|folder| delete(folder));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::artefacts::ObjectArtefacts;
    use std::sync::Arc;

    #[test]
    fn what_scenes_left_goes_at_once_and_what_the_machine_has_stays() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let store = ObjectArtefacts::open(&dir.path().join("store").to_string_lossy()).expect("a store");
        let work = dir.path().join("work");
        let host = FarmHost::new(&work, ArtefactSession::new(Arc::new(store)));
        let scene = |name: &str, photos: &str| {
            let job = SceneJob {
                name: format!("night/{name}"),
                path: work.join("inputs").join(photos),
                out: work.join("runs/night").join(name),
                settings: BTreeMap::new(),
                until: None,
            };
            for folder in [&job.path, &job.out] {
                std::fs::create_dir_all(folder).expect("a folder");
                files::write_plain(folder.join("file"), "of the scene").expect("it is written");
            }
            job
        };
        let (left, kept, done) = (scene("left", "x"), scene("kept", "y"), scene("done", "y"));
        lock(&host.used).insert(kept.path.clone(), 2);
        let is_there = |scene: &SceneJob| (scene.out.exists(), scene.path.exists());
        assert!(host.reclaim(&[&kept, &done]) && !host.reclaim(&[&kept, &done]), "there was one");
        assert_eq!([&left, &kept, &done].map(is_there), [(false, false), (true, true), (true, true)]);
        assert!(!host.leave(&kept, true), "it may return");
        // Nobody else uses the photos any more.
        assert!(host.leave(&done, false));
        assert_eq!([&kept, &done].map(is_there), [(true, false), (false, false)]);
        assert!(!folders_in(&removed_in(&work)).is_empty());
        host.clear();
        assert!(folders_in(&removed_in(&work)).is_empty());
        // Where it cannot be put aside, it is deleted on the way.
        std::fs::remove_dir(removed_in(&work)).expect("it is empty");
        assert!(host.leave(&kept, false) && !kept.out.exists());
    }
}
