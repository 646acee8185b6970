//! The photos of a scene at one size: decoded once for all who need a photo at about the same time.
//!
//! The stages of a run need the same photos at different times: for the sky, the embedding, the masks, the training, the
//! scene tree, the evaluation. All of them read through one store. A store may have a cache, in which photos outlast it.

use crate::{LoadedPhoto, PackedPhoto, PhotoCache, Scene, SceneError, View};
use segwild_files::lock;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// Decodes the photos of a scene at one size, and keeps those that were read last.
pub struct PhotoStore {
    scene: Arc<Scene>,
    long_side: u32,
    most_bytes: usize,
    cache: Option<Arc<dyn PhotoCache>>,
    memory: Arc<PhotoMemory>,
}

/// Photos in memory.
#[derive(Default)]
struct PhotoMemory {
    held: Mutex<HeldPhotos>,
    decoded: Condvar,
}

/// What the store holds at a moment.
#[derive(Default)]
struct HeldPhotos {
    /// Views with their photos; the last read is the last.
    photos: VecDeque<(usize, Arc<LoadedPhoto>)>,
    bytes: usize,
    /// Views that some thread decodes.
    in_work: Vec<usize>,
}

impl PhotoStore {
    /// The photos of a scene with a long side of at most `long_side` pixels. Up to `most_bytes` of them are kept; the
    /// photo that was read last is kept whatever its size, unless it is 0.
    pub fn new(scene: Arc<Scene>, long_side: u32, most_bytes: usize) -> PhotoStore {
        PhotoStore { scene, long_side, most_bytes, cache: None, memory: Arc::default() }
    }

    /// The store with a cache. Photos that are undistorted, or whose files are much larger than what is used of them, are kept there as
    /// well, so that a file is decoded once whatever the memory.
    #[must_use]
    pub fn with_cache(self, cache: Arc<dyn PhotoCache>) -> PhotoStore {
        PhotoStore { cache: Some(cache), ..self }
    }

    /// The same photos for the scene with other poses; both stores keep photos together.
    #[must_use]
    pub fn posed(&self, scene: Arc<Scene>) -> PhotoStore {
        let (cache, memory) = (self.cache.clone(), self.memory.clone());
        PhotoStore { scene, cache, memory, ..*self }
    }

    /// The scene.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The long side of photos, in pixels.
    pub fn long_side(&self) -> u32 {
        self.long_side
    }

    /// Bytes of the photos that are kept.
    pub fn bytes(&self) -> usize {
        self.held().bytes
    }

    /// A photo, as [`View::load`] decodes it. Whoever comes while it is decoded waits for it.
    ///
    /// # Errors
    /// When its file cannot be read, or is not the one any more that it was when the scene was opened. Nothing is kept
    /// of a failure: the next reader tries again.
    pub fn read(&self, view: usize) -> Result<Arc<LoadedPhoto>, SceneError> {
        let view_of = &self.scene.views[view];
        let mut held = self.held();
        loop {
            if let Some(photo) = held.take(view) {
                // A photo that has changed since is no photo of this scene.
                if let Err(changed) = view_of.intact() {
                    held.bytes -= photo.bytes();
                    return Err(changed);
                }
                held.photos.push_back((view, photo.clone()));
                return Ok(photo);
            }
            if !held.in_work.contains(&view) {
                break;
            }
            held = self.memory.decoded.wait(held).unwrap_or_else(PoisonError::into_inner);
        }
        held.in_work.push(view);
        drop(held);
        let work = InWork { store: self, view };
        let photo = Arc::new(self.load(view)?);
        self.held().keep(view, &photo, self.most_bytes);
        drop(work);
        Ok(photo)
    }

    /// What [`View::examine`] finds. A photo of a large file that the cache keeps is put there, so that it is not decoded for this
    /// alone. One that is kept because it is undistorted is not: all cores examine photos at once, and would undistort as many.
    ///
    /// # Errors
    /// As [`View::examine`].
    pub fn examine(&self, view: usize) -> Result<Option<String>, SceneError> {
        let of = &self.scene.views[view];
        if self.cache.is_some() && of.is_larger_than(self.long_side) {
            of.examine_as(|| self.load(view))
        } else {
            of.examine(self.long_side)
        }
    }

    /// The cache, if it keeps this photo.
    fn cache_of(&self, view: &View) -> Option<&dyn PhotoCache> {
        self.cache.as_deref().filter(|_| view.is_dear_at(self.long_side))
    }

    /// Reads a photo from the cache, or decodes it.
    fn load(&self, view: usize) -> Result<LoadedPhoto, SceneError> {
        let of = &self.scene.views[view];
        let Some(cache) = self.cache_of(of) else { return of.load(self.long_side) };
        let kept =
            cache.photo(view).and_then(|photo| photo.unpack(of.camera.scaled_to(self.long_side.max(1))));
        if let Some(photo) = kept {
            of.intact()?;
            return Ok(photo);
        }
        let photo = of.load(self.long_side)?;
        cache.keep(view, &PackedPhoto::of(&photo));
        Ok(photo)
    }

    fn held(&self) -> MutexGuard<'_, HeldPhotos> {
        lock(&self.memory.held)
    }
}

impl HeldPhotos {
    /// Takes a photo out.
    fn take(&mut self, view: usize) -> Option<Arc<LoadedPhoto>> {
        let at = self.photos.iter().position(|(other, _)| *other == view)?;
        self.photos.remove(at).map(|(_, photo)| photo)
    }

    /// Adds a photo, and drops those that were not read for longest.
    fn keep(&mut self, view: usize, photo: &Arc<LoadedPhoto>, most_bytes: usize) {
        if most_bytes == 0 {
            return;
        }
        self.bytes += photo.bytes();
        self.photos.push_back((view, photo.clone()));
        while self.bytes > most_bytes && self.photos.len() > 1 {
            let (_, oldest) = self.photos.pop_front().expect("there are two");
            self.bytes -= oldest.bytes();
        }
    }
}

/// A view that this thread decodes. When it ends, also by a panic, whoever waits goes on.
struct InWork<'a> {
    store: &'a PhotoStore,
    view: usize,
}

impl Drop for InWork<'_> {
    fn drop(&mut self) {
        self.store.held().in_work.retain(|&view| view != self.view);
        self.store.memory.decoded.notify_all();
    }
}
