//! The sky of each photo: waiting for it and reading it.

use crate::artifacts::recompute::{CachedArtefact, Recompute};
use crate::run::view_slots::ViewSlots;
use crate::{RunError, RunFolder};
use segwild_flow::ledger::State;
use segwild_flow::{ActorFailure, Events, Key, Ledger, lock};
use segwild_scene::{Mask, PhotoStore};
use segwild_vision::SkyDetector;
use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// The skies that the masks actor finds: which photos have one, and their masks in the cache. A sky that has been
/// damaged since is found again, and is never taken for a photo without a sky: the keys of what is made from it depend
/// on it.
pub struct Skies {
    /// Per view, whether its sky is in the cache; `false` when it was given up.
    known: ViewSlots<bool>,
    recompute: Recompute,
    photos: Arc<PhotoStore>,
    keys: Vec<Key>,
    detector: Arc<dyn SkyDetector>,
    lost: Mutex<Option<ActorFailure>>,
    /// Views whose sky is still to be requested, the most urgent first.
    open: Mutex<VecDeque<usize>>,
    /// Microseconds that were spent in [`Skies::wait`].
    waited_us: AtomicU64,
}

impl Skies {
    /// No sky is known yet. `keys` has the key of each view's sky.
    pub fn new(
        recompute: Recompute,
        photos: Arc<PhotoStore>,
        keys: Vec<Key>,
        detector: Arc<dyn SkyDetector>,
    ) -> Skies {
        let (known, lost, open) = (ViewSlots::new("sky"), Mutex::default(), Mutex::default());
        Skies { known, recompute, photos, keys, detector, lost, open, waited_us: AtomicU64::new(0) }
    }

    /// Sets the views whose sky is to be found, in this order until [`Skies::prefer`] changes it.
    pub fn plan(&self, views: impl IntoIterator<Item = usize>) {
        lock(&self.open).extend(views);
    }

    /// Sorts the open views by the order of `wanted`, the others after them. The trainer waits for the sky of each
    /// photo when it comes to it, and must not wait for all of them because it starts with the last.
    pub fn prefer(&self, wanted: &[usize]) {
        let rank = |view: &usize| wanted.iter().position(|w| w == view).unwrap_or(usize::MAX);
        lock(&self.open).make_contiguous().sort_by_cached_key(rank);
    }

    /// The view whose sky is to be found next; `None` when all were requested.
    pub fn next_open(&self) -> Option<usize> {
        lock(&self.open).pop_front()
    }

    /// Sets whether a view's sky is in the cache.
    pub fn set(&self, view: usize, found: bool) {
        self.known.set(view, found);
    }

    /// Whether a view's sky is known to be in the cache.
    pub fn found(&self, view: usize) -> bool {
        self.known.get(view) == Some(true)
    }

    /// Waits until it is known whether a view has a sky; `None` when `stopping` says so first.
    pub fn wait(&self, view: usize, stopping: impl Fn() -> bool) -> Option<bool> {
        let since = Instant::now();
        let known = self.known.wait(view, stopping);
        self.waited_us.fetch_add(since.elapsed().as_micros() as u64, Ordering::Relaxed);
        known
    }

    /// Whether it is known whether a view has a sky.
    pub fn is_known(&self, view: usize) -> bool {
        self.known.get(view).is_some()
    }

    /// Seconds that the training has waited for skies.
    pub fn waited_s(&self) -> f64 {
        self.waited_us.load(Ordering::Relaxed) as f64 * 1e-6
    }

    /// A view's sky; `None` if it was given up.
    ///
    /// # Errors
    /// When it was found once and can neither be read nor found again. [`Skies::lost`] then returns the same failure.
    pub fn read(&self, view: usize) -> Result<Option<Mask>, ActorFailure> {
        if !self.found(view) {
            return Ok(None);
        }
        let sky = kept_or_found(&self.recompute, view, &self.keys[view], &self.photos, &*self.detector);
        sky.map(Some).inspect_err(|failure| {
            lock(&self.lost).get_or_insert_with(|| failure.clone());
        })
    }

    /// Why a sky was lost, if one was: what was made without it must not be kept.
    pub fn lost(&self) -> Option<ActorFailure> {
        lock(&self.lost).clone()
    }
}

/// A view's sky from the cache, or found again.
fn kept_or_found(
    recompute: &Recompute,
    view: usize,
    key: &Key,
    photos: &PhotoStore,
    detector: &dyn SkyDetector,
) -> Result<Mask, ActorFailure> {
    recompute.read(CachedArtefact { view, what: "sky", kind: "sky", key }, || {
        let photo = photos.read(view).map_err(ActorFailure::retry)?;
        let seen = recompute.scene.points_in(view, photo.image.width, photo.image.height);
        Ok(detector.sky_above(&photo.image, &seen)?)
    })
}

/// Returns a reader of the skies that a run has found. It gives `None` for a sky that was given up.
pub(crate) fn of_run(
    folder: &RunFolder,
    photos: Arc<PhotoStore>,
    detector: Arc<dyn SkyDetector>,
) -> Result<impl Fn(usize) -> Option<Mask> + Send + Sync + use<>, RunError> {
    let rows = Ledger::open_read_only(folder.ledger())?.views("sky")?;
    let done = rows.into_iter().filter(|row| row.outcome.state == State::Done);
    let keys: BTreeMap<String, Key> =
        done.filter_map(|row| Some((row.view, Key::parse("sky", &row.key)?))).collect();
    let recompute =
        Recompute { scene: photos.scene().clone(), cache: folder.cache()?, events: Events::new() };
    Ok(move |view: usize| {
        let key = keys.get(&recompute.scene.views[view].name)?;
        kept_or_found(&recompute, view, key, &photos, &*detector).ok()
    })
}
