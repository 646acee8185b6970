//! The store of photos: one decoding for all readers, a bound on what is kept, and files that change meanwhile.

use crate::common::{SIZE, line, open, write, write_photo};
use segwild_scene::{PhotoStore, SceneError};
use std::sync::{Arc, Barrier};

/// Bytes of a photo of [`SIZE`].
const PHOTO: usize = 4 * 3 * SIZE.0 * SIZE.1;

fn store(dir: &std::path::Path, most_bytes: usize) -> PhotoStore {
    write(dir, &line(4));
    PhotoStore::new(Arc::new(open(dir).unwrap()), 1000, most_bytes)
}

#[test]
fn readers_at_the_same_time_share_one_decoded_photo() {
    let dir = tempfile::tempdir().unwrap();
    let (store, start) = (store(dir.path(), 1 << 20), Barrier::new(8));
    let photos: Vec<_> = std::thread::scope(|scope| {
        let read = || {
            start.wait();
            store.read(2).unwrap()
        };
        let readers: Vec<_> = (0..8).map(|_| scope.spawn(read)).collect();
        readers.into_iter().map(|reader| reader.join().unwrap()).collect()
    });
    assert!(photos.iter().all(|photo| Arc::ptr_eq(photo, &photos[0])));
    assert_eq!(*photos[0], store.scene().views[2].load(1000).unwrap());
    assert_eq!(store.bytes(), PHOTO);
}

#[test]
fn the_photos_that_were_read_last_are_kept_within_the_bound() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path(), 2 * PHOTO);
    let [first, second] = [0, 1].map(|view| store.read(view).unwrap());
    assert!(Arc::ptr_eq(&first, &store.read(0).unwrap()));
    // The second is the one that was not read for longest.
    store.read(2).unwrap();
    assert_eq!(store.bytes(), 2 * PHOTO);
    assert!(Arc::ptr_eq(&first, &store.read(0).unwrap()));
    assert!(!Arc::ptr_eq(&second, &store.read(1).unwrap()));
}

#[test]
fn a_store_without_memory_keeps_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path(), 0);
    let first = store.read(0).unwrap();
    assert!(*first == *store.read(0).unwrap() && store.bytes() == 0);
}

#[test]
fn a_photo_that_changes_after_it_was_read_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path(), 1 << 20);
    store.read(1).unwrap();
    std::fs::remove_file(dir.path().join("images/photo01.png")).unwrap();
    let refused = store.read(1).unwrap_err();
    assert!(matches!(&refused, SceneError::Changed { name, .. } if name == "photo01.png"), "{refused}");
    assert_eq!(store.bytes(), 0);
}

#[test]
fn a_photo_that_cannot_be_read_fails_for_every_reader_and_none_waits_for_ever() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path(), 1 << 20);
    std::fs::write(dir.path().join("images/photo03.png"), b"no photo").unwrap();
    let (store, start) = (&store, &Barrier::new(4));
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(move || {
                start.wait();
                let text = store.read(3).unwrap_err().to_string();
                assert!(text.contains("photo03.png"), "{text}");
            });
        }
    });
    // The others are as before.
    write_photo(dir.path(), "unrelated.png");
    assert!(store.read(0).is_ok());
}
