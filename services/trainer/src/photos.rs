//! Photos as the trainer needs them: loaded one at a time, kept as bytes, at several sizes.

use crate::TrainError;
use rayon::prelude::*;
use segwild_objective::compare::PhotoTarget;
use segwild_scene::{
    Camera, Image, LoadedPhoto, Mask, ReaderError, TASK_PIXELS, in_pieces, per_piece, per_pixel,
};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};

/// A photo with what is known of its pixels.
#[derive(Clone, Debug)]
pub struct TrainPhoto {
    /// sRGB in [0, 1], three planes, at the size to train at.
    pub image: Image,
    /// Pixels that may be trained on; `None`: all. Undistortion borders and ignored things are outside.
    pub valid: Option<Mask>,
    /// Pixels of the sky; `None`: not known, which is not the same as no sky.
    pub sky: Option<Mask>,
    /// Pixels of transients, as a person has corrected them: these are left out, and no others. `None`: to be found.
    pub transients: Option<Mask>,
}

impl TrainPhoto {
    /// A loaded photo with its sky, as far as that is known. Where a cut-out is empty no splat is to stand, as before a sky;
    /// its sky is that, whatever a sky detector finds in the grey there.
    pub fn new(loaded: LoadedPhoto, sky: Option<Mask>) -> TrainPhoto {
        let LoadedPhoto { image, valid, empty, .. } = loaded;
        match empty {
            None => TrainPhoto { image, valid, sky, transients: None },
            Some(empty) => {
                let valid = valid.map(|valid| valid.or(&empty));
                TrainPhoto { image, valid, sky: Some(empty), transients: None }
            }
        }
    }
}

/// Where photos come from. A call may block until the photo (and its sky) is there.
pub trait Photos: Send + Sync {
    /// The photo of view `view`; the error says why it cannot be used.
    fn photo(&self, view: usize) -> Result<TrainPhoto, ReaderError>;

    /// Why a view's photo is known not to be usable, before it is loaded.
    fn refused(&self, _view: usize) -> Option<String> {
        None
    }

    /// Whether [`Photos::photo`] has all it needs now, and would wait for nobody.
    fn is_ready(&self, _view: usize) -> bool {
        true
    }
}

/// Photos some of which are known not to be usable.
pub struct Sifted<P> {
    /// Where they come from.
    pub photos: P,
    /// Per view, why it is not usable, if so.
    pub refused: Vec<Option<String>>,
}

impl<P: Photos> Photos for Sifted<P> {
    fn photo(&self, view: usize) -> Result<TrainPhoto, ReaderError> {
        if let Some(reason) = self.refused(view) {
            return Err(reason.into());
        }
        self.photos.photo(view)
    }

    fn refused(&self, view: usize) -> Option<String> {
        self.refused.get(view).cloned().flatten()
    }

    fn is_ready(&self, view: usize) -> bool {
        self.photos.is_ready(view)
    }
}

impl<F, E> Photos for F
where
    F: Fn(usize) -> Result<TrainPhoto, E> + Send + Sync,
    E: Into<ReaderError>,
{
    fn photo(&self, view: usize) -> Result<TrainPhoto, ReaderError> {
        self(view).map_err(E::into)
    }
}

/// A photo at one size, a byte per value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PhotoLevel {
    pub width: usize,
    pub height: usize,
    /// Planar, as [`Image::data`].
    rgb: Vec<u8>,
    /// Per pixel: [`VALID`] and [`SKY`].
    flags: Vec<u8>,
}

const VALID: u8 = 1;
const SKY: u8 = 2;

/// A photo at full, half and quarter size.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Stored {
    pub levels: Vec<PhotoLevel>,
    /// Whether it shows a sky.
    pub has_sky: bool,
    /// Whether its transients are known; their pixels are then not valid.
    pub transients_known: bool,
}

/// Sizes kept per photo.
pub(crate) const LEVELS: usize = 3;

impl PhotoLevel {
    pub fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// The colours as floats.
    pub fn image(&self) -> Image {
        let mut data = vec![0.0f32; self.rgb.len()];
        in_pieces(&mut data, |first, piece| {
            piece.iter_mut().zip(&self.rgb[first..]).for_each(|(v, &b)| *v = f32::from(b) * (1.0 / 255.0));
        });
        Image { width: self.width, height: self.height, channels: 3, data }
    }

    /// Whether the pixel counts in the colour loss: valid and not sky.
    #[inline]
    pub fn counts(&self, i: usize) -> bool {
        self.flags[i] == VALID
    }

    /// Whether the pixel is valid sky.
    #[inline]
    pub fn sky(&self, i: usize) -> bool {
        self.flags[i] == VALID | SKY
    }

    /// Share of the pixels that are no sky.
    pub fn ground(&self) -> f32 {
        (0..self.pixels()).filter(|&i| !self.sky(i)).count() as f32 / self.pixels().max(1) as f32
    }

    #[inline]
    pub fn valid(&self, i: usize) -> bool {
        self.flags[i] & VALID != 0
    }

    /// Whether a pixel lies in a mask of the photo, of whatever size.
    #[inline]
    pub fn lies_in(&self, i: usize, mask: &Mask) -> bool {
        let of = |at: usize, size: usize, other: u32| (at * other as usize / size) as u32;
        mask.get(of(i % self.width, self.width, mask.width()), of(i / self.width, self.height, mask.height()))
    }

    #[inline]
    pub fn colour(&self, i: usize) -> [f32; 3] {
        let n = self.pixels();
        [0, 1, 2].map(|c| f32::from(self.rgb[c * n + i]) * (1.0 / 255.0))
    }

    /// The photo with the flags of its pixels, its initial transients, and the trust of each pixel to show
    /// the scene itself.
    pub fn target(&self, initial_transients: Option<&Mask>, trust: Vec<f32>) -> PhotoTarget {
        let (n, w, h) = (self.pixels(), self.width, self.height);
        let mut pixels = vec![[0u8; 4]; n];
        let rows = pixels.par_chunks_exact_mut(w).with_min_len(TASK_PIXELS.div_ceil(w)).enumerate();
        rows.for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                let i = y * w + x;
                let mut flags = u8::from(self.counts(i)) * PhotoTarget::COUNTS;
                if self.sky(i) {
                    let inner = (x == 0 || self.sky(i - 1))
                        && (x + 1 == w || self.sky(i + 1))
                        && (y == 0 || self.sky(i - w))
                        && (y + 1 == h || self.sky(i + w));
                    flags |= PhotoTarget::SKY | (u8::from(inner) * PhotoTarget::INNER);
                }
                if initial_transients.is_some_and(|mask| self.lies_in(i, mask)) {
                    flags |= PhotoTarget::INITIAL_TRANSIENT;
                }
                *pixel = [self.rgb[i], self.rgb[n + i], self.rgb[2 * n + i], flags];
            }
        });
        PhotoTarget { width: w, height: h, pixels, trust }
    }

    /// Half the size: each pixel is the mean of four; it is valid if all four are, sky if three are.
    fn half(&self) -> PhotoLevel {
        let (w, h) = (self.width / 2, self.height / 2);
        let (n, m) = (self.pixels(), w * h);
        let mut out = PhotoLevel { width: w, height: h, rgb: vec![0; 3 * m], flags: vec![0; m] };
        let (whole, task) = (self.width, TASK_PIXELS.div_ceil(w));
        for c in 0..3 {
            let plane = &self.rgb[c * n..][..n];
            let rows = out.rgb[c * m..][..m].par_chunks_exact_mut(w).with_min_len(task).enumerate();
            rows.for_each(|(y, row)| {
                let (upper, lower) = two_rows(plane, whole, y);
                for ((mean, up), low) in row.iter_mut().zip(upper).zip(lower) {
                    let sum = u16::from(up[0]) + u16::from(up[1]) + u16::from(low[0]) + u16::from(low[1]);
                    *mean = ((sum + 2) / 4) as u8;
                }
            });
        }
        let rows = out.flags.par_chunks_exact_mut(w).with_min_len(task).enumerate();
        rows.for_each(|(y, row)| {
            let (upper, lower) = two_rows(&self.flags, whole, y);
            for ((flags, up), low) in row.iter_mut().zip(upper).zip(lower) {
                let four = [up[0], up[1], low[0], low[1]];
                let valid = four.iter().all(|flags| flags & VALID != 0);
                let sky = four.iter().filter(|flags| *flags & SKY != 0).count() >= 3;
                *flags = (u8::from(valid) * VALID) | (u8::from(sky) * SKY);
            }
        });
        out
    }
}

/// The two rows of a plane that make row `y` of one of half the size, in pairs.
fn two_rows(plane: &[u8], width: usize, y: usize) -> (&[[u8; 2]], &[[u8; 2]]) {
    let (upper, lower) = plane[2 * y * width..][..2 * width].split_at(width);
    (upper.as_chunks::<2>().0, lower.as_chunks::<2>().0)
}

impl Stored {
    /// Checks a photo and packs it.
    pub fn pack(name: &str, photo: &TrainPhoto) -> Result<Stored, TrainError> {
        let refuse = |reason: String| TrainError::Photo { name: name.to_owned(), reason };
        let TrainPhoto { image, valid, sky, transients } = photo;
        let n = image.pixels();
        if image.channels != 3 || n == 0 || image.data.len() != 3 * n {
            return Err(refuse(format!(
                "expected three colour planes, got {} of {} x {}",
                image.channels, image.width, image.height
            )));
        }
        let odd = per_piece(image.data.len(), |piece| {
            let start = piece.start;
            image.data[piece].iter().position(|v| !v.is_finite()).map(|i| start + i)
        });
        if let Some(i) = odd.into_iter().flatten().next() {
            let p = i % n;
            return Err(refuse(format!(
                "colour at pixel ({}, {}) is not a number; decode the file again",
                p % image.width,
                p / image.width
            )));
        }
        for (what, mask) in [("valid", valid), ("sky", sky), ("transients'", transients)] {
            if let Some(m) = mask
                && (m.width() as usize, m.height() as usize) != (image.width, image.height)
            {
                return Err(refuse(format!(
                    "the {what} mask is {} x {}, the photo {} x {}",
                    m.width(),
                    m.height(),
                    image.width,
                    image.height
                )));
            }
        }
        let flags: Vec<u8> = per_pixel(n, |i| {
            let transient = transients.as_ref().is_some_and(|m| m.index(i));
            let valid = valid.as_ref().is_none_or(|m| m.index(i)) && !transient;
            let sky = sky.as_ref().is_some_and(|m| m.index(i));
            (u8::from(valid) * VALID) | (u8::from(sky) * SKY)
        });
        if flags.iter().all(|f| f & VALID == 0) {
            let which = if transients.is_some() {
                "its masks of transients and of what to ignore"
            } else {
                "its ignore mask"
            };
            return Err(refuse(format!("every pixel is masked out; check {which}")));
        }
        let mut rgb = vec![0u8; 3 * n];
        in_pieces(&mut rgb, |first, piece| {
            let values = piece.iter_mut().zip(&image.data[first..]);
            values.for_each(|(b, v)| *b = (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8);
        });
        let mut levels = vec![PhotoLevel { width: image.width, height: image.height, rgb, flags }];
        while levels.len() < LEVELS {
            let last = levels.last().expect("there is a first level");
            if last.width < 32 || last.height < 32 {
                break;
            }
            let next = last.half();
            levels.push(next);
        }
        let has_sky = sky.as_ref().is_some_and(|sky| !sky.is_empty());
        Ok(Stored { levels, has_sky, transients_known: transients.is_some() })
    }

    /// Of the most of it that may be transients, what transients are still searched for in: nothing where they are known.
    pub fn transient_share(&self, most: f32) -> f32 {
        if self.transients_known { 0.0 } else { most }
    }

    fn bytes(&self) -> usize {
        self.levels.iter().map(|l| l.rgb.len() + l.flags.len()).sum()
    }

    /// The camera of a level, given the photo's.
    pub fn camera(&self, photo: &Camera, level: usize) -> Camera {
        let full = photo.resized(self.levels[0].width as u32, self.levels[0].height as u32);
        let (level, size) = self.level(level);
        level_camera(&full, level, size)
    }

    /// The requested level, or the smallest there is.
    pub fn level(&self, level: usize) -> (usize, &PhotoLevel) {
        let l = level.min(self.levels.len() - 1);
        (l, &self.levels[l])
    }
}

/// The camera of a level: every halving drops an odd last row or column, the rest is exact.
fn level_camera(full: &Camera, level: usize, size: &PhotoLevel) -> Camera {
    let s = 0.5f32.powi(level as i32);
    Camera {
        width: size.width as u32,
        height: size.height as u32,
        fx: full.fx * s,
        fy: full.fy * s,
        cx: full.cx * s,
        cy: full.cy * s,
    }
}

/// Photos within a memory budget, the least recently used dropped first. What it returns never depends on
/// what it holds, so neither does the training.
pub(crate) struct TrainPhotoCache {
    source: Arc<dyn Photos>,
    names: Vec<String>,
    held: BTreeMap<usize, (u64, Arc<Stored>)>,
    clock: u64,
    bytes: usize,
    limit: usize,
    /// Reads a photo while the step before works. No pool that others compute in: a thread that waits there for a photo that another
    /// decodes may be the one that the other waits for. It has one thread, on which a photo is read and packed whole.
    reader: Option<rayon::ThreadPool>,
    /// The view whose photo the reader reads, and where it will be; nothing after a panic.
    ahead: Option<(usize, Receiver<Result<Stored, TrainError>>)>,
}

impl Drop for TrainPhotoCache {
    /// Nothing reads photos, or writes a run's cache of them, after its training.
    fn drop(&mut self) {
        self.ahead.take().map(|(_, read)| read.recv());
    }
}

/// Reads and packs a photo.
fn read(source: &dyn Photos, view: usize, name: &str) -> Result<Stored, TrainError> {
    let photo = source.photo(view);
    let photo = photo.map_err(|e| TrainError::Photo { name: name.to_owned(), reason: e.to_string() })?;
    Stored::pack(name, &photo)
}

impl TrainPhotoCache {
    pub fn new(source: Arc<dyn Photos>, names: Vec<String>, limit: usize) -> TrainPhotoCache {
        TrainPhotoCache {
            source,
            names,
            held: BTreeMap::new(),
            clock: 0,
            bytes: 0,
            limit,
            reader: None,
            ahead: None,
        }
    }

    /// Has another thread read a photo that [`TrainPhotoCache::get`] will return next, if it does not wait for a stage.
    pub fn read_ahead(&mut self, view: usize) {
        let ordered = self.ahead.as_ref().is_some_and(|(ahead, _)| *ahead == view);
        if ordered || self.held.contains_key(&view) || !self.source.is_ready(view) {
            return;
        }
        if self.reader.is_none() {
            let reader = rayon::ThreadPoolBuilder::new().num_threads(1).thread_name(|_| "read ahead".into());
            self.reader = reader.build().ok();
        }
        // Without a thread it is read when it is wanted.
        let Some(reader) = &self.reader else { return };
        let (source, name) = (self.source.clone(), self.names[view].clone());
        let (done, ahead) = channel();
        reader.spawn(move || {
            // After a panic it is read when it is wanted, and panics where panics are dealt with.
            let stored = catch_unwind(AssertUnwindSafe(|| read(&*source, view, &name)));
            drop(stored.map(|stored| done.send(stored)));
        });
        self.ahead = Some((view, ahead));
    }

    /// Takes the cache with all it holds; an empty one is left.
    pub fn take(&mut self) -> TrainPhotoCache {
        let empty = TrainPhotoCache::new(self.source.clone(), self.names.clone(), self.limit);
        std::mem::replace(self, empty)
    }

    /// Why a view's photo is known not to be usable, before it is loaded.
    pub fn refused(&self, view: usize) -> Option<(String, String)> {
        self.source.refused(view).map(|reason| (self.names[view].clone(), reason))
    }

    /// Another budget, in bytes.
    pub fn limit_to(&mut self, limit: usize) {
        self.limit = limit;
        self.evict();
    }

    fn evict(&mut self) {
        while self.bytes > self.limit && !self.held.is_empty() {
            let (&oldest, _) = self.held.iter().min_by_key(|(_, (used, _))| *used).expect("not empty");
            let (_, gone) = self.held.remove(&oldest).expect("just found");
            self.bytes -= gone.bytes();
        }
    }

    /// A photo for work beside the training; `None` of one that cannot be read: it is named and left out when it is
    /// trained on.
    pub fn usable(&mut self, view: usize) -> Result<Option<Arc<Stored>>, TrainError> {
        match self.get(view) {
            Ok(stored) => Ok(Some(stored)),
            Err(TrainError::Photo { .. }) => Ok(None),
            Err(other) => Err(other),
        }
    }

    pub fn get(&mut self, view: usize) -> Result<Arc<Stored>, TrainError> {
        self.clock += 1;
        if let Some((used, stored)) = self.held.get_mut(&view) {
            *used = self.clock;
            return Ok(stored.clone());
        }
        let ahead = self.ahead.take_if(|(ahead, _)| *ahead == view).and_then(|(_, read)| read.recv().ok());
        let stored = ahead.unwrap_or_else(|| read(&*self.source, view, &self.names[view]));
        let stored = Arc::new(stored?);
        self.bytes += stored.bytes();
        self.evict();
        self.held.insert(view, (self.clock, stored.clone()));
        Ok(stored)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn photo(v: f32) -> TrainPhoto {
        TrainPhoto { image: Image::filled(65, 40, 3, v), valid: None, sky: None, transients: None }
    }

    #[test]
    fn cache_stays_within_its_budget_and_returns_the_same() {
        let loads = Arc::new(AtomicUsize::new(0));
        let counter = loads.clone();
        let source = Arc::new(move |i: usize| {
            counter.fetch_add(1, Ordering::Relaxed);
            Ok::<_, std::convert::Infallible>(photo(i as f32 / 10.0))
        });
        let names = (0..4).map(|i| i.to_string()).collect();
        let one = Stored::pack("x", &photo(0.1)).unwrap().bytes();
        let mut cache = TrainPhotoCache::new(source, names, 2 * one);
        for i in [0, 1, 0, 2, 0, 1] {
            let got = cache.get(i).unwrap();
            assert!((got.levels[0].colour(3)[0] - i as f32 / 10.0).abs() < 0.003);
            assert!(cache.bytes <= 2 * one);
        }
        // 0 and 1, then 2 drops 1, then 1 again.
        assert_eq!(loads.load(Ordering::Relaxed), 4);
    }

    /// Photos that count how often each is read.
    struct Counted {
        reads: [AtomicUsize; 4],
        ready: bool,
    }

    impl Photos for Counted {
        fn photo(&self, view: usize) -> Result<TrainPhoto, ReaderError> {
            self.reads[view].fetch_add(1, Ordering::SeqCst);
            if view == 2 { Err("it is damaged".into()) } else { Ok(photo(0.1 * view as f32)) }
        }

        fn is_ready(&self, _: usize) -> bool {
            self.ready
        }
    }

    #[test]
    fn a_photo_read_ahead_is_the_same_and_is_read_once() {
        let source = Arc::new(Counted { reads: Default::default(), ready: true });
        let names: Vec<String> = (0..4).map(|i| i.to_string()).collect();
        let mut cache = TrainPhotoCache::new(source.clone(), names.clone(), usize::MAX);
        let reads = |view: usize| source.reads[view].load(Ordering::SeqCst);
        let mut ahead = |view: usize| {
            cache.read_ahead(view);
            cache.get(view)
        };
        assert_eq!(*ahead(1).unwrap(), Stored::pack("1", &photo(0.1)).unwrap());
        assert_eq!(*ahead(1).unwrap(), Stored::pack("1", &photo(0.1)).unwrap());
        assert_eq!(reads(1), 1);
        let error = ahead(2).unwrap_err().to_string();
        assert!(error.contains("photo `2`") && error.contains("it is damaged"), "{error}");
        // One that is not wanted after all is forgotten, and one whose sky is not there yet is not waited for.
        cache.read_ahead(0);
        assert!(cache.get(1).is_ok());
        let waits = Arc::new(Counted { reads: Default::default(), ready: false });
        let mut cache = TrainPhotoCache::new(waits.clone(), names, usize::MAX);
        cache.read_ahead(0);
        assert!(cache.ahead.is_none() && waits.reads[0].load(Ordering::SeqCst) == 0);
    }

    #[test]
    fn a_photo_that_panics_when_it_is_read_ahead_panics_when_it_is_wanted() {
        let reads = Arc::new(AtomicUsize::new(0));
        let counter = reads.clone();
        let source = Arc::new(move |_: usize| -> Result<TrainPhoto, std::convert::Infallible> {
            counter.fetch_add(1, Ordering::SeqCst);
            panic!("a decoder's fault")
        });
        let mut cache = TrainPhotoCache::new(source, vec!["0".into()], usize::MAX);
        cache.read_ahead(0);
        let wanted = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| cache.get(0).map(drop)));
        assert!(wanted.is_err() && reads.load(Ordering::SeqCst) == 2);
    }

    #[test]
    fn no_photo_is_read_after_the_training_that_wanted_it() {
        let (go_on, goes_on) = channel::<()>();
        let (done, dones) = channel();
        let goes_on = Mutex::new(goes_on);
        let source = Arc::new(move |_: usize| {
            goes_on.lock().unwrap().recv().expect("it is let go on");
            done.send(()).unwrap();
            Ok::<_, std::convert::Infallible>(photo(0.5))
        });
        let mut cache = TrainPhotoCache::new(source, vec!["0".into()], usize::MAX);
        cache.read_ahead(0);
        let (dropped, drops) = channel();
        let training = std::thread::spawn(move || {
            drop(cache);
            dropped.send(()).unwrap();
        });
        assert!(drops.recv_timeout(std::time::Duration::from_millis(50)).is_err(), "it waits");
        go_on.send(()).unwrap();
        drops.recv().expect("it ends");
        assert!(dones.try_recv().is_ok());
        training.join().unwrap();
    }

    #[test]
    fn a_photo_is_read_ahead_by_one_thread_that_nothing_else_computes_on() {
        let threads = Arc::new(Mutex::new(Vec::new()));
        let seen = threads.clone();
        let source = Arc::new(move |_: usize| {
            // More than one task: a pool would share them.
            let all = per_piece(4 * TASK_PIXELS, |_| std::thread::current().name().map(str::to_owned));
            seen.lock().unwrap().extend(all);
            Ok::<_, std::convert::Infallible>(photo(0.5))
        });
        let mut cache = TrainPhotoCache::new(source, vec!["0".into(); 2], usize::MAX);
        for view in [0, 1] {
            cache.read_ahead(view);
            cache.get(view).unwrap();
        }
        let threads = threads.lock().unwrap();
        assert!(threads.len() == 8 && threads.iter().all(|name| name.as_deref() == Some("read ahead")));
    }

    #[test]
    fn a_photo_that_another_thread_decodes_does_not_stop_the_only_thread_of_the_pool() {
        let (decoded, decodes) = std::sync::mpsc::channel::<()>();
        let decodes = Mutex::new(decodes);
        // The photo is there when somebody else has done work in the pool.
        let source = Arc::new(move |_: usize| {
            decodes.lock().unwrap().recv().expect("it is decoded");
            Ok::<_, std::convert::Infallible>(photo(0.5))
        });
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let mut cache = TrainPhotoCache::new(source, vec!["0".into()], usize::MAX);
        pool.install(|| cache.read_ahead(0));
        pool.install(|| decoded.send(()).expect("it is awaited"));
        assert!(cache.get(0).is_ok());
    }

    #[test]
    fn a_photo_in_which_nothing_is_sky_has_none() {
        let with = |sky| Stored::pack("x", &TrainPhoto { sky, ..photo(0.5) }).unwrap().has_sky;
        assert!(with(Some(Mask::full(65, 40))));
        assert!(!with(Some(Mask::empty(65, 40))) && !with(None));
    }

    #[test]
    fn bad_photos_are_refused_by_name() {
        let mut nan = photo(0.5);
        nan.image.data[70] = f32::NAN;
        let error = Stored::pack("a.jpg", &nan).unwrap_err().to_string();
        assert!(error.contains("a.jpg") && error.contains("(5, 1)"), "{error}");
        let masked = TrainPhoto { valid: Some(Mask::empty(65, 40)), ..photo(0.5) };
        assert!(Stored::pack("b.jpg", &masked).unwrap_err().to_string().contains("masked out"));
        let wrong = TrainPhoto { sky: Some(Mask::empty(3, 3)), ..photo(0.5) };
        assert!(Stored::pack("c.jpg", &wrong).unwrap_err().to_string().contains("3 x 3"));
    }

    #[test]
    fn halving_keeps_masks_apart() {
        let sky = Mask::from_fn(65, 40, |_, y| y < 20);
        let valid = Mask::from_fn(65, 40, |x, _| x < 60);
        let p = TrainPhoto { sky: Some(sky), valid: Some(valid), ..photo(0.5) };
        let s = Stored::pack("x", &p).unwrap();
        let (l, half) = s.level(1);
        assert_eq!((l, half.width, half.height), (1, 32, 20));
        assert!(half.sky(0) && half.counts(15 * 32) && !half.valid(31));
        // The requested level does not exist on a small photo: the smallest one is returned.
        assert_eq!(s.level(9).0, s.levels.len() - 1);
    }
}
