//! What no scene of a farm needs is removed from a shared folder, and nothing else.

use segwild_farm::{
    ArtefactDigest, ArtefactError, ArtefactSession, ArtefactStore, EmbeddedEngine, FarmSweep, FarmSweepError,
    Job, JobEngine, Needs, ObjectArtefacts, SweptArtefacts, WorkerOffer,
};
use std::collections::BTreeSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Barrier};
use std::time::{Duration, SystemTime};

const HOUR: Duration = Duration::from_secs(3600);

struct SweptFarm {
    folder: PathBuf,
    store: Arc<ObjectArtefacts>,
    engine: EmbeddedEngine,
}

impl SweptFarm {
    fn in_folder(folder: &Path) -> Self {
        let store = ObjectArtefacts::open(&folder.join("shared").display().to_string()).unwrap();
        let engine = EmbeddedEngine::open(folder.join("jobs.sqlite")).unwrap();
        Self { folder: folder.to_owned(), store: Arc::new(store), engine }
    }

    /// A folder of files, stored by a program of its own.
    fn stored(&self, name: &str, texts: &[&str]) -> ArtefactDigest {
        let folder = self.folder.join(name);
        std::fs::create_dir_all(&folder).unwrap();
        for text in texts {
            std::fs::write(folder.join(text), text).unwrap();
        }
        ArtefactSession::new(self.store.clone()).store_folder(&folder, &|_| true).unwrap()
    }

    fn job(&self, id: &str, photos: &ArtefactDigest) {
        let payload = format!("{{\"photos\": \"{photos}\", \"settings\": {{}}}}");
        self.engine.publish(&Job::new(id, payload, Needs::default())).unwrap();
    }

    /// Lets everything in the store be so old.
    fn age(&self, age: Duration) {
        for folder in std::fs::read_dir(self.folder.join("shared")).unwrap().flatten() {
            let inner = folder.path();
            let files = if inner.is_dir() { std::fs::read_dir(inner).unwrap() } else { continue };
            for file in files.flatten() {
                File::open(file.path()).unwrap().set_modified(SystemTime::now() - age).unwrap();
            }
        }
    }

    fn sweep(
        &self,
        hours: u32,
        dry_run: bool,
    ) -> Result<(SweptArtefacts, BTreeSet<ArtefactDigest>), FarmSweepError> {
        let artefacts = ArtefactSession::new(self.store.clone());
        let farms: Vec<(String, &dyn JobEngine)> = vec![("night".to_owned(), &self.engine as &dyn JobEngine)];
        let older_than = hours * HOUR;
        let mut shown = BTreeSet::new();
        let sweep = FarmSweep { farms, artefacts: &artefacts, older_than, dry_run };
        let swept = sweep.sweep(&mut |artefact| {
            shown.insert(artefact.digest);
        })?;
        Ok((swept, shown))
    }

    /// Whether a folder can be fetched whole.
    fn has(&self, folder: &ArtefactDigest) -> bool {
        let into = self.folder.join("into").join(folder.to_string());
        let fetched = ArtefactSession::new(self.store.clone()).fetch_folder(folder, &into);
        let _ = std::fs::remove_dir_all(&into);
        match fetched {
            Ok(_) => true,
            Err(ArtefactError::Missing { .. }) => false,
            Err(error) => panic!("{error}"),
        }
    }
}

#[test]
fn what_no_job_state_or_result_refers_to_is_removed_and_a_dry_run_only_lists_it() {
    let dir = tempfile::tempdir().unwrap();
    let farm = SweptFarm::in_folder(dir.path());
    let [photos, early, late, result] = [
        farm.stored("photos", &["a", "b"]),
        farm.stored("early", &["b", "state 1"]),
        farm.stored("late", &["b", "state 2"]),
        farm.stored("result", &["model"]),
    ];
    let withdrawn = farm.stored("withdrawn", &["b", "c"]);
    farm.job("night/a", &photos);
    farm.job("night/b", &photos);
    let offer = WorkerOffer::all("w", Needs::default(), 600.0);
    let lease = farm.engine.claim(&offer).unwrap().unwrap();
    for state in [&early, &late] {
        farm.engine.checkpoint(&lease, &state.to_string()).unwrap();
    }
    farm.engine.complete(&lease, &format!("{{\"seconds\": 1, \"artefact\": \"{result}\"}}")).unwrap();
    std::fs::write(dir.path().join("shared/notes.txt"), "somebody's own").unwrap();
    assert_eq!(farm.sweep(72, false).unwrap().0.removed.artefacts, 0, "all of it is young");
    farm.age(100 * HOUR);
    let young = farm.stored("young", &["d"]);
    // Two manifests, and the files that no other folder has.
    let expected: BTreeSet<_> =
        [early, withdrawn, ArtefactDigest::of(b"state 1"), ArtefactDigest::of(b"c")].into();
    let (would, listed) = farm.sweep(72, true).unwrap();
    assert_eq!((listed, would.removed.artefacts), (expected.clone(), 4));
    assert!([photos, early, late, result, withdrawn, young].iter().all(|folder| farm.has(folder)));
    let (swept, removed) = farm.sweep(72, false).unwrap();
    assert_eq!((removed, swept), (expected, would), "as the dry run showed");
    assert_eq!((swept.young.artefacts, swept.used.artefacts, swept.missing), (2, 7, 0), "{swept:?}");
    assert!([photos, late, result, young].iter().all(|folder| farm.has(folder)));
    assert!(![early, withdrawn].iter().any(|folder| farm.has(folder)));
    assert!(dir.path().join("shared/notes.txt").is_file(), "it is none of the store's");
    assert_eq!(farm.sweep(72, false).unwrap().0.removed.artefacts, 0);
}

/// What a worker stores while a sweep goes on: the store has it already, and nothing refers to it yet.
#[test]
fn what_a_worker_stores_again_just_now_is_kept_until_its_record_comes() {
    let dir = tempfile::tempdir().unwrap();
    let farm = SweptFarm::in_folder(dir.path());
    let other = farm.stored("other", &["x"]);
    farm.job("night/other", &other);
    let before = farm.stored("photos", &["a", "b"]);
    farm.age(100 * HOUR);
    // The same photos are handed in again: no byte travels, but what is there is young again.
    assert_eq!(farm.stored("photos", &["a", "b"]), before);
    let (swept, removed) = farm.sweep(72, false).unwrap();
    assert_eq!((removed.len(), swept.young.artefacts), (0, 3), "{swept:?}");
    farm.job("night/again", &before);
    assert!(farm.has(&before));
    // No age is shorter than what that takes, whatever is requested.
    farm.engine.withdraw(&["night/again".to_owned()]).unwrap();
    farm.age(23 * HOUR);
    assert_eq!(farm.sweep(0, false).unwrap().0.removed.artefacts, 0);
    farm.age(25 * HOUR);
    assert_eq!(farm.sweep(0, false).unwrap().0.removed.artefacts, 3);
}

#[test]
fn nothing_is_removed_as_long_as_it_is_not_known_what_is_needed() {
    let dir = tempfile::tempdir().unwrap();
    let farm = SweptFarm::in_folder(dir.path());
    let photos = farm.stored("photos", &["a", "b"]);
    let unused = farm.stored("unused", &["c"]);
    farm.age(100 * HOUR);
    // As with a wrong name or a wrong key.
    let empty = farm.sweep(72, false).map(drop).unwrap_err();
    assert!(matches!(&empty, FarmSweepError::Empty { farm } if farm == "night"), "{empty:?}");
    farm.job("night/a", &photos);
    let newer = Job::new("night/b", "{\"photos\": 7}", Needs::default());
    farm.engine.publish(&newer).unwrap();
    let error = farm.sweep(72, false).map(drop).unwrap_err().to_string();
    assert!(error.contains("`night/b`"), "{error}");
    farm.engine.withdraw(&["night/b".to_owned()]).unwrap();
    // A list of files that is damaged in the store.
    let hex = photos.to_string();
    std::fs::write(dir.path().join("shared").join(&hex[..2]).join(&hex), "{}").unwrap();
    let error = farm.sweep(72, false).map(drop).unwrap_err().to_string();
    assert!(error.contains(&hex), "{error}");
    assert!(farm.has(&unused));
    assert!(farm.store.remove_older(&photos, Duration::ZERO).unwrap());
    // The only one is missing: that is another farm's store.
    let other = farm.sweep(72, true).map(drop).unwrap_err();
    assert!(matches!(other, FarmSweepError::Artefact(ArtefactError::OtherStore { .. })), "{other:?}");
    // One of several that is missing needs nothing any more, and is counted.
    let others = farm.stored("others", &["d"]);
    farm.job("night/c", &others);
    assert_eq!(farm.sweep(72, true).unwrap().0.missing, 1);
}

#[test]
fn the_store_of_another_farm_is_not_emptied() {
    let dir = tempfile::tempdir().unwrap();
    let [ours, theirs] = ["ours", "theirs"].map(|name| SweptFarm::in_folder(&dir.path().join(name)));
    let [photos, needed] = [ours.stored("photos", &["a"]), theirs.stored("photos", &["b"])];
    ours.job("night/a", &photos);
    theirs.job("night/b", &needed);
    theirs.age(100 * HOUR);
    // The jobs of one farm, and the store of the other one, as with a wrong --artefacts.
    let wrong = SweptFarm { store: theirs.store.clone(), ..ours };
    for dry_run in [true, false] {
        let refused = wrong.sweep(72, dry_run).map(drop);
        let other =
            matches!(&refused, Err(FarmSweepError::Artefact(ArtefactError::OtherStore { folders: 1, .. })));
        assert!(other, "{refused:?}");
    }
    assert!(theirs.has(&needed));
}

#[test]
fn what_killed_transfers_and_sweeps_left_is_removed_or_comes_back() {
    let dir = tempfile::tempdir().unwrap();
    let farm = SweptFarm::in_folder(dir.path());
    let photos = farm.stored("photos", &["a", "b"]);
    farm.job("night/a", &photos);
    let named = |digest: &ArtefactDigest, name: &str| {
        dir.path().join("shared").join(&digest.to_string()[..2]).join(name)
    };
    let half = named(&photos, &format!("{photos}#1"));
    std::fs::write(&half, "ha").unwrap();
    let own = named(&photos, "notes#1");
    std::fs::write(&own, "somebody's own").unwrap();
    // A sweep that was killed had renamed the list of files: without it, the photos would seem to be needed by nobody.
    let swept = named(&photos, &format!(".swept-{photos}.7.8.9"));
    std::fs::rename(named(&photos, &photos.to_string()), &swept).unwrap();
    assert_eq!(farm.sweep(72, false).unwrap().0.removed.artefacts, 0);
    assert!(half.is_file(), "somebody may be writing it");
    farm.age(100 * HOUR);
    let (swept_now, _) = farm.sweep(72, false).unwrap();
    assert_eq!((swept_now.removed.artefacts, swept_now.missing), (0, 0), "{swept_now:?}");
    assert!(farm.has(&photos) && !half.exists() && !swept.exists() && own.is_file());
}

/// Who has stored an artefact counts on it, whatever a sweep does at that moment.
#[test]
fn what_is_stored_while_it_is_removed_is_there_afterwards() {
    let dir = tempfile::tempdir().unwrap();
    let farm = SweptFarm::in_folder(dir.path());
    farm.stored("photos", &["a"]);
    let (digest, file) = (ArtefactDigest::of(b"a"), dir.path().join("photos/a"));
    let (mut removed, barrier) = (0, Barrier::new(2));
    for round in 0..40 {
        farm.age(100 * HOUR);
        std::thread::scope(|scope| {
            let sweeper = scope.spawn(|| {
                barrier.wait();
                farm.store.remove_older(&digest, 72 * HOUR).unwrap()
            });
            barrier.wait();
            farm.store.put(&digest, &file).unwrap();
            removed += u32::from(sweeper.join().unwrap());
        });
        assert!(farm.store.has(&digest).unwrap(), "round {round}, {removed} were removed before");
    }
}
