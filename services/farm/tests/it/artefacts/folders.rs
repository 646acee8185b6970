//! Folders through a store in a shared folder.

use segwild_farm::{
    ArtefactDigest, ArtefactError, ArtefactSession, ArtefactStore, FolderEntry, FolderLimits, FolderManifest,
    ObjectArtefacts, StoredArtefact,
};
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, SystemTime};

/// A store in a shared folder that counts.
struct Counted {
    store: ObjectArtefacts,
    puts: AtomicUsize,
    gets: AtomicUsize,
}

impl ArtefactStore for Counted {
    fn name(&self) -> String {
        self.store.name()
    }
    fn find(&self, digest: &ArtefactDigest) -> Result<Option<StoredArtefact>, ArtefactError> {
        self.store.find(digest)
    }
    fn list(&self, show: &mut dyn FnMut(StoredArtefact)) -> Result<(), ArtefactError> {
        self.store.list(show)
    }
    fn remove_older(&self, digest: &ArtefactDigest, least: Duration) -> Result<bool, ArtefactError> {
        self.store.remove_older(digest, least)
    }
    fn put(&self, digest: &ArtefactDigest, file: &Path) -> Result<(), ArtefactError> {
        self.puts.fetch_add(1, Ordering::Relaxed);
        self.store.put(digest, file)
    }
    fn get(
        &self,
        digest: &ArtefactDigest,
        bytes: RangeInclusive<u64>,
        to: &Path,
    ) -> Result<(), ArtefactError> {
        self.gets.fetch_add(1, Ordering::Relaxed);
        self.store.get(digest, bytes, to)
    }
}

fn counted(dir: &Path) -> Arc<Counted> {
    let store = ObjectArtefacts::open(&dir.join("shared").display().to_string()).unwrap();
    Arc::new(Counted { store, puts: AtomicUsize::new(0), gets: AtomicUsize::new(0) })
}

fn write(path: &Path, text: &str) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, text).unwrap();
    // As if it had been there for long.
    let file = std::fs::File::options().append(true).open(path).unwrap();
    file.set_modified(SystemTime::now() - Duration::from_secs(60)).unwrap();
}

fn photos(dir: &Path) -> std::path::PathBuf {
    let folder = dir.join("scene");
    for (path, text) in
        [("images/a.jpg", "a"), ("images/b.jpg", "b"), ("sparse/0/points3D.bin", "p"), ("notes.txt", "n")]
    {
        write(&folder.join(path), text);
    }
    folder
}

#[test]
fn a_folder_has_one_digest_and_only_what_is_new_goes_over_the_wire() {
    let dir = tempfile::tempdir().unwrap();
    let (folder, store) = (photos(dir.path()), counted(dir.path()));
    let session = ArtefactSession::new(store.clone());
    let wanted = |path: &str| path != "notes.txt";
    let digest = session.store_folder(&folder, &wanted).unwrap();
    assert_eq!(store.puts.load(Ordering::Relaxed), 3 + 1, "the manifest, too");
    assert_eq!(session.store_folder(&folder, &wanted).unwrap(), digest);
    assert_eq!(store.puts.load(Ordering::Relaxed), 4);
    write(&folder.join("images/c.jpg"), "c");
    let further = session.store_folder(&folder, &wanted).unwrap();
    assert_ne!(further, digest);
    assert_eq!(store.puts.load(Ordering::Relaxed), 6);

    let into = dir.path().join("into");
    write(&into.join("images/b.jpg"), "B");
    write(&into.join("mine.txt"), "mine");
    let manifest = session.fetch_folder(&digest, &into).unwrap();
    let paths: Vec<&str> = manifest.files().iter().map(|file| file.path.as_str()).collect();
    assert_eq!(paths, ["images/a.jpg", "images/b.jpg", "sparse/0/points3D.bin"]);
    for (path, text) in [("images/a.jpg", "a"), ("images/b.jpg", "b"), ("mine.txt", "mine")] {
        assert_eq!(std::fs::read_to_string(into.join(path)).unwrap(), text);
    }
    assert_eq!(std::fs::read_dir(&into).unwrap().count(), 3, "no litter");
    let before = store.gets.load(Ordering::Relaxed);
    ArtefactSession::new(store.clone()).fetch_folder(&further, &into).unwrap();
    assert_eq!(store.gets.load(Ordering::Relaxed) - before, 2, "the manifest and one photo");
}

#[test]
fn a_file_of_the_same_length_that_was_changed_is_stored_again() {
    let dir = tempfile::tempdir().unwrap();
    let (folder, store) = (photos(dir.path()), counted(dir.path()));
    let session = ArtefactSession::new(store);
    let first = session.store_folder(&folder, &|_| true).unwrap();
    // Just now, and again within the same tick of the clock of the file system.
    for text in ["1", "2", "3"] {
        std::fs::write(folder.join("notes.txt"), text).unwrap();
        let digest = session.store_folder(&folder, &|_| true).unwrap();
        assert_ne!(digest, first);
        let into = dir.path().join(text);
        session.fetch_folder(&digest, &into).unwrap();
        assert_eq!(std::fs::read_to_string(into.join("notes.txt")).unwrap(), text);
    }
}

/// Stores a manifest as it is.
fn store_manifest(store: &dyn ArtefactStore, dir: &Path, json: &[u8]) -> ArtefactDigest {
    let (file, digest) = (dir.join("manifest"), ArtefactDigest::of(json));
    std::fs::write(&file, json).unwrap();
    store.put(&digest, &file).unwrap();
    digest
}

fn stored_text(store: &dyn ArtefactStore, dir: &Path, path: &str, text: &str) -> FolderEntry {
    let digest = store_manifest(store, dir, text.as_bytes());
    FolderEntry { path: path.into(), digest, bytes: text.len() as u64 }
}

#[test]
fn evil_manifests_write_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (store, into) = (counted(dir.path()), dir.path().join("a/b/into"));
    let session = ArtefactSession::new(store.clone());
    for path in ["../outside", "/tmp/segwild-outside", "x/../../../outside", "x\\..\\outside", ""] {
        let entries = vec![
            stored_text(store.as_ref(), dir.path(), "fine", "fine"),
            stored_text(store.as_ref(), dir.path(), path, "evil"),
        ];
        let digest = store_manifest(store.as_ref(), dir.path(), &FolderManifest::new(entries).to_json());
        let error = session.fetch_folder(&digest, &into).unwrap_err();
        assert!(matches!(error, ArtefactError::Manifest { .. }), "{path}: {error}");
        assert_eq!(std::fs::read_dir(&into).unwrap().count(), 0, "{path}");
    }
    let many = FolderManifest::new(
        (0..3).map(|i| stored_text(store.as_ref(), dir.path(), &i.to_string(), "x")).collect(),
    );
    let digest = store_manifest(store.as_ref(), dir.path(), &many.to_json());
    let narrow = FolderLimits { files: 2, ..FolderLimits::default() };
    assert!(ArtefactSession::within(store.clone(), narrow).fetch_folder(&digest, &into).is_err());
    let short = FolderLimits { manifest_bytes: 20, ..FolderLimits::default() };
    assert!(ArtefactSession::within(store, short).fetch_folder(&digest, &into).is_err());
    session.fetch_folder(&digest, &into).unwrap();
}

#[test]
fn a_file_that_is_longer_than_its_manifest_says_does_not_fill_the_disk() {
    let dir = tempfile::tempdir().unwrap();
    let (store, into) = (counted(dir.path()), dir.path().join("into"));
    let entry = stored_text(store.as_ref(), dir.path(), "a", "sixteen bytes...");
    for bytes in [5, 17] {
        let forged = FolderManifest::new(vec![FolderEntry { bytes, ..entry.clone() }]);
        let digest = store_manifest(store.as_ref(), dir.path(), &forged.to_json());
        let error = ArtefactSession::new(store.clone()).fetch_folder(&digest, &into).unwrap_err();
        assert!(
            matches!(error, ArtefactError::Long { .. } | ArtefactError::Short { .. }),
            "{bytes}: {error}"
        );
        assert_eq!(std::fs::read_dir(&into).unwrap().count(), 0, "{bytes}");
    }
}

#[cfg(unix)]
#[test]
fn a_link_in_the_target_is_not_written_through() {
    use std::os::unix::fs::symlink;
    let dir = tempfile::tempdir().unwrap();
    let (store, into, outside) = (counted(dir.path()), dir.path().join("into"), dir.path().join("outside"));
    let session = ArtefactSession::new(store);
    let digest = session.store_folder(&photos(dir.path()), &|_| true).unwrap();
    write(&outside.join("a.jpg"), "theirs");
    std::fs::create_dir(&into).unwrap();
    symlink(&outside, into.join("images")).unwrap();
    let error = session.fetch_folder(&digest, &into).unwrap_err();
    assert!(matches!(error, ArtefactError::Stray(_)), "{error}");
    std::fs::remove_file(into.join("images")).unwrap();
    std::fs::create_dir(into.join("images")).unwrap();
    symlink(into.join("mine"), into.join("images/a.jpg")).unwrap();
    std::fs::write(into.join("mine"), "mine").unwrap();
    session.fetch_folder(&digest, &into).unwrap();
    assert_eq!(std::fs::read(into.join("mine")).unwrap(), b"mine", "the link is replaced");
    assert_eq!(std::fs::read(into.join("images/a.jpg")).unwrap(), b"a");
    assert_eq!(std::fs::read(outside.join("a.jpg")).unwrap(), b"theirs");
}
