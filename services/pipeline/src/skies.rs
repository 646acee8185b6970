//! The sky of each photo, as those who need it wait for it and read it.

use crate::recompute::{Kept, Recompute};
use crate::view_slots::ViewSlots;
use crate::{RunError, RunFolder};
use segwild_flow::ledger::State;
use segwild_flow::{Events, Failure, Key, Ledger};
use segwild_scene::{Mask, Scene};
use segwild_vision::SkyDetector;
use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Where the masks actor's skies are: which photos have one, and their pixels in the cache. A sky that has been
/// damaged since is found anew, and is never taken for a photo without a sky: what is made from it is named by its key.
pub struct Skies {
    /// Per view, whether its sky is in the cache; `false` when it was given up.
    known: ViewSlots<bool>,
    anew: Recompute,
    size: u32,
    keys: Vec<Key>,
    detector: Arc<dyn SkyDetector>,
    lost: Mutex<Option<Failure>>,
    /// Views whose sky is still to be asked for, the most wanted first.
    open: Mutex<VecDeque<usize>>,
    /// Microseconds that were spent in [`Skies::wait`].
    waited_us: AtomicU64,
}

impl Skies {
    /// Nothing is known yet. `keys` name each view's sky.
    pub fn new(anew: Recompute, size: u32, keys: Vec<Key>, detector: Arc<dyn SkyDetector>) -> Skies {
        let (known, lost, open) = (ViewSlots::new("sky"), Mutex::default(), Mutex::default());
        Skies { known, anew, size, keys, detector, lost, open, waited_us: AtomicU64::new(0) }
    }

    /// Says whose sky is to be found, in this order until [`Skies::prefer`] knows a better one.
    pub fn plan(&self, views: impl IntoIterator<Item = usize>) {
        lock(&self.open).extend(views);
    }

    /// Puts those that are still open in the order in which they are wanted, the others after them: a trainer waits for
    /// the sky of each photo when it comes to it, and must not wait for all of them because it begins with the last.
    pub fn prefer(&self, wanted: &[usize]) {
        let place = |view: &usize| wanted.iter().position(|w| w == view).unwrap_or(usize::MAX);
        lock(&self.open).make_contiguous().sort_by_cached_key(place);
    }

    /// The view whose sky is to be found next; `None` when all were asked for.
    pub fn next_open(&self) -> Option<usize> {
        lock(&self.open).pop_front()
    }

    /// Says whether a view's sky is in the cache.
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

    /// Seconds that the training has stood still for want of a sky.
    pub fn waited_s(&self) -> f64 {
        self.waited_us.load(Ordering::Relaxed) as f64 * 1e-6
    }

    /// A view's sky; `None` if it was given up.
    ///
    /// # Errors
    /// When it was found once and can be had no more; [`Skies::lost`] then knows it, too.
    pub fn read(&self, view: usize) -> Result<Option<Mask>, Failure> {
        if !self.found(view) {
            return Ok(None);
        }
        let sky = kept_or_found(&self.anew, view, &self.keys[view], self.size, &*self.detector);
        sky.map(Some).inspect_err(|failure| {
            lock(&self.lost).get_or_insert_with(|| failure.clone());
        })
    }

    /// Why a sky could not be had any more, if so: what was made without it is not to be kept.
    pub fn lost(&self) -> Option<Failure> {
        lock(&self.lost).clone()
    }
}

/// A view's sky out of the cache, or found as it was found first.
fn kept_or_found(
    anew: &Recompute,
    view: usize,
    key: &Key,
    size: u32,
    detector: &dyn SkyDetector,
) -> Result<Mask, Failure> {
    anew.read(Kept { view, what: "sky", kind: "sky", key }, || {
        let photo = anew.scene.views[view].load(size).map_err(Failure::retry)?;
        let seen = anew.scene.points_in(view, photo.image.width, photo.image.height);
        Ok(detector.sky_above(&photo.image, &seen)?)
    })
}

/// Reads the skies that a run has found, at the long side `size` that it found them at; one that was given up is not known.
pub(crate) fn of_run(
    folder: &RunFolder,
    scene: &Arc<Scene>,
    size: u32,
    detector: Arc<dyn SkyDetector>,
) -> Result<impl Fn(usize) -> Option<Mask> + Send + Sync + use<>, RunError> {
    let rows = Ledger::open_read_only(folder.ledger())?.views("sky")?;
    let done = rows.into_iter().filter(|row| row.outcome.state == State::Done);
    let keys: BTreeMap<String, Key> =
        done.filter_map(|row| Some((row.view, Key::parse("sky", &row.key)?))).collect();
    let anew = Recompute { scene: scene.clone(), cache: folder.cache()?, events: Events::new() };
    Ok(move |view: usize| {
        let key = keys.get(&anew.scene.views[view].name)?;
        kept_or_found(&anew, view, key, size, &*detector).ok()
    })
}
