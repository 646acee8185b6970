//! The store of photos: one decoding for all readers, a bound on what is kept, and files that change meanwhile.

use crate::common::{SIZE, line, open, write, write_photo};
use segwild_scene::colmap::CameraModel;
use segwild_scene::lens::Lens;
use segwild_scene::{PackedPhoto, PhotoCache, PhotoStore, SceneError};
use std::collections::BTreeMap;
use std::sync::{Arc, Barrier, Mutex};

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

/// A cache in memory.
#[derive(Default)]
struct InMemory(Mutex<BTreeMap<usize, PackedPhoto>>);

impl PhotoCache for InMemory {
    fn photo(&self, view: usize) -> Option<PackedPhoto> {
        self.0.lock().unwrap().get(&view).cloned()
    }

    fn keep(&self, view: usize, photo: &PackedPhoto) {
        self.0.lock().unwrap().insert(view, photo.clone());
    }
}

/// A store without memory, with a cache, of photos that are used at a long side of so many pixels.
fn cached(dir: &std::path::Path, long_side: u32) -> (PhotoStore, Arc<InMemory>) {
    write(dir, &line(4));
    let (scene, cache) = (Arc::new(open(dir).unwrap()), Arc::new(InMemory::default()));
    (PhotoStore::new(scene, long_side, 0).with_cache(cache.clone()), cache)
}

#[test]
fn a_large_photo_is_decoded_once_and_is_the_same_from_the_cache() {
    let dir = tempfile::tempdir().unwrap();
    let half = SIZE.0 as u32 / 2;
    let (store, cache) = cached(dir.path(), half);
    let decoded = store.scene().views[0].load(half).unwrap();
    assert_eq!(*store.read(0).unwrap(), decoded);
    assert_eq!(cache.photo(0), Some(PackedPhoto::of(&decoded)));
    // What the cache holds is what is read: it is not decoded again.
    let black = segwild_scene::Image::zeros(decoded.image.width, decoded.image.height, 3);
    let other = PackedPhoto::of(&segwild_scene::LoadedPhoto { image: black, ..decoded });
    cache.keep(0, &other);
    assert_eq!(PackedPhoto::of(&store.read(0).unwrap()), other);
    // To examine a photo is to read it.
    assert!(store.examine(1).unwrap().is_none() && cache.photo(1).is_some());
    // A record of another size is no photo of this store.
    cache.keep(2, &PackedPhoto::of(&store.scene().views[2].load(half / 2).unwrap()));
    assert_eq!(*store.read(2).unwrap(), store.scene().views[2].load(half).unwrap());
}

#[test]
fn a_photo_of_about_the_size_that_is_used_takes_no_space_in_the_cache() {
    let dir = tempfile::tempdir().unwrap();
    let (store, cache) = cached(dir.path(), SIZE.0 as u32 * 3 / 4);
    store.read(0).unwrap();
    assert!(store.examine(1).unwrap().is_none() && cache.0.lock().unwrap().is_empty());
}

#[test]
fn an_undistorted_photo_is_kept_when_it_is_read_and_not_undistorted_to_be_examined() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &line(2));
    let (width, height) = (SIZE.0 as u32, SIZE.1 as u32);
    let deep = |x: u32, y: u32| image::Rgb([900 * x + 7, 1000 * y + 5, 700 * (x + y)].map(|v| v as u16));
    let deep = image::ImageBuffer::from_fn(width, height, deep);
    image::DynamicImage::ImageRgb16(deep).save(dir.path().join("images/photo01.png")).unwrap();
    let mut scene = open(dir.path()).unwrap();
    let params = [50.0, f64::from(width) / 2.0, f64::from(height) / 2.0, 0.1];
    let lens = Lens::new(CameraModel::SimpleRadial, width.into(), height.into(), &params).unwrap();
    scene.views.iter_mut().for_each(|view| view.photo.lens = Some(lens.clone()));
    let cache = Arc::new(InMemory::default());
    let store = PhotoStore::new(Arc::new(scene), 1000, 0).with_cache(cache.clone());
    // Undistorting makes values that no pixel has; each is kept with the bits of a pixel all the same.
    for (view, bytes_of_value) in [(0, 1), (1, 2)] {
        assert!(store.examine(view).unwrap().is_none() && cache.photo(view).is_none());
        let read = store.read(view).unwrap();
        let bytes = wincode::serialize(&cache.photo(view).unwrap()).unwrap().len();
        let values = read.image.data.len();
        let fits = bytes_of_value * values..(bytes_of_value + 1) * values;
        assert!(fits.contains(&bytes), "photo {view}: {bytes} bytes for {values} values");
        assert_eq!(*store.read(view).unwrap(), *read);
    }
}

#[test]
fn a_photo_that_has_changed_is_not_read_from_the_cache() {
    let dir = tempfile::tempdir().unwrap();
    let (store, _) = cached(dir.path(), SIZE.0 as u32 / 2);
    store.read(1).unwrap();
    std::fs::remove_file(dir.path().join("images/photo01.png")).unwrap();
    let refused = store.read(1).unwrap_err();
    assert!(matches!(&refused, SceneError::Changed { name, .. } if name == "photo01.png"), "{refused}");
}
