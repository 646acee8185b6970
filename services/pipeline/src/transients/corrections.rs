//! Transients as pictures: what each photo shows that the scene does not, for a person to look at and put right.
//!
//! `RUN/transients/PHOTO.png` is white where a transient stands, in pixels of the photo as taken. `made.json` beside them says which pixels this program
//! has written and from what. A picture with other pixels is a person's: it is never written over, and the next run
//! leaves out of the photo exactly what it says, whatever the program would find. What is damaged is made again
//! ([`crate::transients::authorship`]).

use crate::images::{Pictures, same_shape};
use crate::transients::authorship::{self as made, FOLDER, Ledger, MADE, Made, Picture, pixels};
use crate::{RunError, RunFolder};
use rayon::prelude::*;
use segwild_flow::{Cache, Failure, FileError, Key};
use segwild_raster::Engine;
use segwild_scene::{Mask, MaskFiles, Scene, View};
use segwild_trainer::{Model, TrainPhoto, TransientEvidence, transient_evidence};
use segwild_vision::{PromptSegmenter, TransientDetector};
use serde::Serialize;
use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Most of a photo that may be transients when they are looked for in the trained scene.
const MOST: f32 = 0.6;
/// Kind of the cache's records of what the network finds.
const KIND: &str = "transients";

/// Masks that persons have put right, by view.
#[derive(Clone, Debug, Default)]
pub struct Corrections {
    found: Vec<Option<Correction>>,
    /// Pictures of the run's own folder that are nobody's work, and what is wrong with each.
    damaged: Vec<(PathBuf, String)>,
    /// Views whose picture cannot be used, and why: to train on them would show what is to be left out.
    unusable: Vec<(usize, String)>,
}

#[derive(Clone, Debug)]
struct Correction {
    file: PathBuf,
    /// In the undistorted photo.
    mask: Mask,
    digest: String,
}

impl Corrections {
    /// Finds the pictures that a person made or changed: in the folder that was named, else in the run's own. [`Corrections::unusable`]
    /// lists those of the named folder that cannot be read or do not fit their photo.
    ///
    /// # Errors
    /// When the named folder is not there or holds no picture of a photo; names a picture of the run's own that does not fit its photo.
    pub fn find(scene: &Scene, folder: &RunFolder, named: &str) -> Result<Corrections, RunError> {
        if !named.is_empty() && !Path::new(named).is_dir() {
            return Err(RunError::Request(format!("--transient-masks {named}: there is no such folder")));
        }
        let (pictures, made) = (pictures(scene), Ledger::of(folder));
        let own = folder.path().join(FOLDER);
        let photos = scene.views.iter().map(|v| v.name.as_str());
        let named_files = (!named.is_empty()).then(|| MaskFiles::new(Path::new(named), photos));
        let mut corrections = Corrections::default();
        for (i, view) in scene.views.iter().enumerate() {
            let file = named_files.as_ref().map_or(Ok(None), |files| files.find(&view.name));
            let given = file.and_then(|file| file.map(|file| read(file, view)).transpose());
            let file = pictures.find(&own, i);
            let of_own = match made::look_at(&file, made.of_photo(&pictures, i))? {
                Picture::Theirs(mask) => {
                    let misfit = |reason| RunError::Folder { path: file.clone(), reason };
                    Some(Correction::of(file.clone(), mask, view).map_err(misfit)?)
                }
                Picture::Damaged(reason) => {
                    corrections.damaged.push((file, reason));
                    None
                }
                Picture::None | Picture::Ours(_) => None,
            };
            match given {
                Ok(given) => corrections.found.push(given.or(of_own)),
                Err(reason) => {
                    let reason = format!("its mask in --transient-masks {named} cannot be used: {reason}");
                    corrections.unusable.push((i, reason));
                    corrections.found.push(None);
                }
            }
        }
        let of_named = |c: &Correction| c.file.starts_with(named);
        let some =
            corrections.unusable.len() + corrections.found.iter().flatten().filter(|c| of_named(c)).count();
        if !named.is_empty() && some == 0 {
            let reason = "it holds no picture with the name of a photo of this scene";
            return Err(RunError::Request(format!("--transient-masks {named}: {reason}")));
        }
        Ok(corrections)
    }

    /// Views whose picture cannot be used, each with the reason: they are left out.
    pub fn unusable(&self) -> &[(usize, String)] {
        &self.unusable
    }

    /// Puts pictures aside that are nobody's work, so that they are made again; says so, a sentence each.
    ///
    /// # Errors
    /// When one cannot be moved.
    pub fn put_damaged_aside(&self) -> Result<Vec<String>, RunError> {
        made::put_aside(&self.damaged)
    }

    /// What a view's is, for names of what is made with it.
    pub fn digest(&self, view: usize) -> Option<&str> {
        Some(self.found.get(view)?.as_ref()?.digest.as_str())
    }

    /// What all of them are; `None` when there is none.
    pub fn digest_of_all(&self) -> Option<String> {
        let mut hasher = blake3::Hasher::new();
        for (view, one) in self.found.iter().enumerate() {
            if let Some(one) = one {
                hasher.update(format!("{view} {}\n", one.digest).as_bytes());
            }
        }
        self.found.iter().any(Option::is_some).then(|| hasher.finalize().to_hex()[..32].to_owned())
    }

    /// A view's, at the size of its loaded photo.
    pub fn mask(&self, view: usize, width: u32, height: u32) -> Option<Mask> {
        Some(self.found.get(view)?.as_ref()?.mask.resized(width, height))
    }

    /// Which photos have one, in words; `None` when none has.
    pub fn in_words(&self, scene: &Scene) -> Option<String> {
        let names: Vec<&str> = (0..self.found.len())
            .filter(|&view| self.found[view].is_some())
            .map(|view| scene.views[view].name.as_str())
            .collect();
        let listed = names.iter().take(3).copied().collect::<Vec<_>>().join(", ");
        match names.len() {
            0 => None,
            1..=3 => Some(format!("transients as they were put right by hand: {listed}")),
            n => Some(format!("transients as they were put right by hand: {listed} and {} more", n - 3)),
        }
    }
}

impl Correction {
    fn of(file: PathBuf, mask: Mask, view: &View) -> Result<Correction, String> {
        fits(&mask, view)?;
        Ok(Correction { digest: pixels(&mask), file, mask: view.mask_from_taken(mask) })
    }
}

/// A picture that a person names.
fn read(file: PathBuf, view: &View) -> Result<Correction, String> {
    let mask = Mask::read_png(&file).map_err(|error| error.to_string())?;
    let place = file.display().to_string();
    Correction::of(file, mask, view).map_err(|reason| format!("{place}: {reason}"))
}

/// Refuses a mask of another shape than its photo's.
fn fits(mask: &Mask, view: &View) -> Result<(), String> {
    let (w, h) = (mask.width(), mask.height());
    let (pw, ph) = (view.camera.width, view.camera.height);
    if same_shape((w, h), (pw, ph)) {
        return Ok(());
    }
    Err(format!("it has {w} x {h} pixels, which does not fit {}'s {pw} x {ph}", view.name))
}

fn pictures(scene: &Scene) -> Pictures {
    Pictures::of(scene.views.iter().map(|v| v.name.as_str()))
}

/// Reads the pictures of a run's transients by view, in the undistorted photo; `None` where there is none that can be read.
pub(crate) fn of_run(
    folder: &RunFolder,
    scene: &Scene,
) -> impl Fn(usize) -> Option<Mask> + Send + Sync + use<> {
    let (own, pictures) = (folder.path().join(FOLDER), pictures(scene));
    let views = scene.views.clone();
    move |view: usize| {
        let taken = Mask::read_png(&pictures.find(&own, view)).ok()?;
        Some(views[view].mask_from_taken(taken))
    }
}

/// Pictures of a run that are nobody's work, a sentence each: their photos are taken without.
pub(crate) fn damaged(folder: &RunFolder, scene: &Scene) -> Vec<String> {
    let (own, pictures) = (folder.path().join(FOLDER), pictures(scene));
    let files = (0..scene.views.len()).map(|view| pictures.find(&own, view));
    let said = |file: PathBuf| {
        let reason = made::damage_of(&file)?;
        Some(format!(
            "{} is damaged ({reason}) and is passed over; `segwild run` makes it again",
            file.display()
        ))
    };
    files.filter_map(said).collect()
}

/// What is known of a photo's transients before anything is trained.
#[derive(Clone)]
pub struct Known {
    /// By hand.
    pub corrections: Arc<Corrections>,
    /// By a network.
    pub network: Option<Arc<dyn TransientDetector>>,
    /// Where the network's answers are kept.
    pub cache: Cache,
    /// Their names, by view.
    pub keys: Arc<Vec<Key>>,
}

impl Known {
    /// Writes what is known into a photo: what a person put right stands as it is; what the network finds is left out,
    /// and more may be found.
    pub fn tell(&self, view: usize, photo: &mut TrainPhoto) -> Result<(), String> {
        let (w, h) = (photo.image.width as u32, photo.image.height as u32);
        if let Some(mask) = self.corrections.mask(view, w, h) {
            photo.transients = Some(mask);
        } else if let Some(network) = &self.network {
            let find = || network.transients(&photo.image);
            let (mask, _) =
                self.cache.get_or_make(&self.keys[view], KIND, find).map_err(|e| e.to_string())?;
            let valid = photo.valid.take().unwrap_or_else(|| Mask::full(w, h));
            photo.valid = Some(valid.minus(&mask));
        }
        Ok(())
    }

    /// As [`Known::tell`], without the network, which was asked at another size.
    pub fn tell_hand(&self, view: usize, photo: &mut TrainPhoto) {
        let (w, h) = (photo.image.width as u32, photo.image.height as u32);
        photo.transients = self.corrections.mask(view, w, h);
    }

    /// The transients that are known of a photo before training, for its picture.
    fn mask(&self, view: usize) -> Option<Mask> {
        self.network.as_ref()?;
        self.cache.get_typed(&self.keys[view], KIND).ok().flatten()
    }
}

/// Makes the pictures of a run's transients.
pub(crate) struct Album<'a> {
    pub folder: &'a RunFolder,
    pub scene: &'a Scene,
    pub model: &'a Model,
    pub engine: &'a dyn Engine,
    pub segmenter: &'a dyn PromptSegmenter,
    pub known: &'a Known,
    /// Photos looked at at once.
    pub at_once: usize,
}

impl Album<'_> {
    /// Writes the pictures of these views that are not there already; `key` names what a view's is made from, and
    /// `photo` loads it. Returns what is to be said of single photos.
    pub fn write(
        &self,
        views: &[usize],
        key: impl Fn(usize) -> Key,
        photo: impl Fn(usize) -> Result<TrainPhoto, Failure> + Sync,
        mut told: impl FnMut(&str) -> Result<(), Failure>,
    ) -> Result<Vec<String>, Failure> {
        let (named, mut notes) = (pictures(self.scene), Vec::new());
        let before = Ledger::of(self.folder);
        let own = self.folder.path().join(FOLDER);
        let (mut after, mut open) = (BTreeMap::new(), Vec::new());
        for &view in views {
            let (name, mut key) = (named.name(view), key(view).to_string());
            if self.scene.views[view].photo.lens.is_some() {
                // Pictures of distorted photos were once of the undistorted ones.
                key += " as taken";
            }
            let made = before.of_photo(&named, view).cloned().unwrap_or_default();
            let failed = |e: FileError| Failure::storage(e.to_string());
            let there = match made::look_at(&named.find(&own, view), Some(&made)).map_err(failed)? {
                Picture::Theirs(_) => {
                    after.insert(name.to_owned(), made);
                    continue;
                }
                Picture::Ours(there) => Some(there),
                Picture::None | Picture::Damaged(_) => None,
            };
            let file = own.join(name);
            if there.is_some() && made.key == key && file.is_file() {
                after.insert(name.to_owned(), made);
            } else {
                open.push(Open { view, name, key, file, there });
            }
        }
        let mut pictures = Vec::new();
        let mut shares = Vec::new();
        for some in open.chunks(self.at_once) {
            for &Open { view, .. } in some {
                told(&self.scene.views[view].name)?;
            }
            let masks = self.transients(some, &photo)?;
            for (Open { view, name, key, file, there }, (mask, psnr)) in some.iter().zip(masks) {
                notes.extend(odd(&self.scene.views[*view].name, name, &mask, psnr));
                shares.push(share_of(&mask));
                let mask = self.scene.views[*view].mask_to_taken(mask);
                let pixels = [pixels(&mask)].into_iter().chain(there.clone()).collect();
                after.insert((*name).to_owned(), Made { key: key.clone(), pixels });
                pictures.push((file, mask));
            }
        }
        notes.extend(crowded(&shares));
        let failed = |e: RunError| Failure::storage(e.to_string());
        // Said before it is done: a picture of this program is never taken for a person's.
        self.folder.write_json(MADE, &after).map_err(failed)?;
        for (file, mask) in pictures {
            made::write(file, &mask).map_err(failed)?;
        }
        Ok(notes)
    }

    /// The transients of some photos, and how well each fits: what contradicts the trained scene, out to the photo's own
    /// boundaries, and what was known before. One after the other is compared with the scene, since an engine may be one device.
    fn transients(
        &self,
        some: &[Open],
        photo: &(impl Fn(usize) -> Result<TrainPhoto, Failure> + Sync),
    ) -> Result<Vec<(Mask, f32)>, Failure> {
        let photos: Vec<TrainPhoto> =
            some.par_iter().map(|open| photo(open.view)).collect::<Result<_, Failure>>()?;
        let compare = |(open, photo): (&Open, &TrainPhoto)| {
            transient_evidence(self.model, self.engine, self.scene, open.view, photo, MOST)
        };
        let compared = some.iter().zip(&photos).map(compare).collect::<Result<Vec<_>, _>>()?;
        let snap = |((open, photo), compared): ((&Open, &TrainPhoto), &TransientEvidence)| {
            (self.snapped(open.view, photo, compared), compared.psnr)
        };
        Ok(some.par_iter().zip(&photos).zip(&compared).map(snap).collect())
    }

    fn snapped(&self, view: usize, photo: &TrainPhoto, compared: &TransientEvidence) -> Mask {
        if let Some(mask) = &photo.transients {
            return mask.clone();
        }
        let found = match &compared.certainty {
            // A provider that sees no thing there leaves the scene's own word.
            Some(certainty) => match self.segmenter.refine(&photo.image, certainty) {
                Ok(snapped) => snapped.mask,
                Err(_) => {
                    let (w, h) = (certainty.width as u32, certainty.height as u32);
                    Mask::over(w, h, certainty.plane(0), 0.5)
                        .resized(photo.image.width as u32, photo.image.height as u32)
                }
            },
            None => Mask::empty(photo.image.width as u32, photo.image.height as u32),
        };
        self.known.mask(view).map_or(found.clone(), |known| found.or(&known))
    }
}

/// A photo whose picture is to be made.
struct Open<'a> {
    view: usize,
    /// The picture's name, where it goes, and what it is made from.
    name: &'a str,
    file: PathBuf,
    key: String,
    /// Hash of the pixels of the one that is there.
    there: Option<String>,
}

/// A photo that fits worse than this, and in which hardly anything stands out, has another trouble than transients.
const MISFIT: f32 = 12.0;

/// What is odd about a photo's mask: that nearly all of it is strange, or hardly anything of one that does not fit at all.
fn odd(photo: &str, picture: &str, mask: &Mask, psnr: f32) -> Option<String> {
    let share = share_of(mask);
    let percent = 100.0 * share;
    if share > MOST {
        return Some(format!(
            "photo {photo}: {percent:.0} % of it contradicts the scene; put {FOLDER}/{picture} right, or leave the photo out"
        ));
    }
    (psnr < MISFIT && share < 0.05).then(|| {
        format!(
            "photo {photo} does not fit the scene ({psnr:.1} dB), and only {percent:.0} % of it stands out as strange: its \
             pose may be wrong, or its light beyond the look; paint its transients into {FOLDER}/{picture}, or leave it out"
        )
    })
}

fn share_of(mask: &Mask) -> f32 {
    mask.count() as f32 / (f64::from(mask.width()) * f64::from(mask.height())).max(1.0) as f32
}

/// A photo of which this share contradicts the scene is crowded. What is found is less than what is there: of 25 % that
/// transients truly cover about 20 % is found, and hardly more however much they cover.
const CROWDED: f32 = 0.2;
/// Share of the photos that must be crowded for all of them to be spoken of.
const MANY: f32 = 0.34;

/// What is to be said where many photos contradict the scene.
fn crowded(shares: &[f32]) -> Option<String> {
    let many = shares.iter().filter(|s| **s > CROWDED).count();
    (shares.len() > 2 && many as f32 > MANY * shares.len() as f32).then(|| {
        format!(
            "in {many} of {} photos more than {:.0} % contradicts the scene: transients in most of them, light beyond the look, or \
             poses that do not fit",
            shares.len(),
            100.0 * CROWDED
        )
    })
}

/// Score of the transients of one photo.
#[derive(Clone, Debug, Serialize)]
pub struct TransientScore {
    /// The photo's name.
    pub photo: String,
    /// Intersection over union with the true mask; 1 where both are empty.
    pub iou: f64,
    /// Share of the photo that is truly covered.
    pub covered: f64,
    /// Share of the photo that was taken for a transient and is none.
    pub false_share: f64,
}

/// Scores of a run's transients.
#[derive(Clone, Debug, Serialize)]
pub struct TransientScores {
    /// Mean over the photos that show transients.
    pub iou: f64,
    /// Over all pixels of all photos together.
    pub pooled_iou: f64,
    /// Mean share of the photos that was taken for a transient and is none.
    pub false_share: f64,
    /// Per photo.
    pub photos: Vec<TransientScore>,
    /// Pictures that could not be read or do not fit, and why: their photos do not count.
    pub unread: Vec<String>,
}

/// A run's picture of a photo and the true one, in pixels of the true one.
fn compared(found: &Path, truth: &Path) -> Result<(Mask, Mask), String> {
    let read = |file: &Path| Mask::read_png(file).map_err(|e| e.to_string());
    let (found, true_one) = (read(found)?, read(truth)?);
    let (w, h) = (true_one.width(), true_one.height());
    if !same_shape((w, h), (found.width(), found.height())) {
        let (pw, ph) = (found.width(), found.height());
        return Err(format!(
            "{} has {w} x {h} pixels, which does not fit the photo's {pw} x {ph}",
            truth.display()
        ));
    }
    Ok((found.resized(w, h), true_one))
}

/// Scores a run's pictures of transients against true ones in `truth`, one picture per photo, named as the photo ([`MaskFiles`]).
///
/// # Errors
/// When the folder is not there or holds nothing that counts; a single picture that cannot be read is listed.
pub fn score_transients(folder: &RunFolder, truth: &Path) -> Result<TransientScores, RunError> {
    let intake = folder.intake()?;
    if !truth.is_dir() {
        return Err(RunError::Input(format!(
            "--transient-masks {}: there is no such folder",
            truth.display()
        )));
    }
    let (mut photos, mut unread) = (Vec::new(), Vec::new());
    let (mut both, mut either) = (0.0, 0.0);
    let names = intake.photos.iter().map(String::as_str);
    let (pictures, truths) = (Pictures::of(names.clone()), MaskFiles::new(truth, names));
    let (own, held_out) = (folder.path().join(FOLDER), intake.held_out.iter().collect::<HashSet<_>>());
    for (i, photo) in intake.photos.iter().enumerate().filter(|(_, photo)| !held_out.contains(photo)) {
        let found = pictures.find(&own, i);
        let Some(file) = truths.find(photo).transpose().filter(|_| found.is_file()) else { continue };
        let (found, truth) = match file.and_then(|file| compared(&found, &file)) {
            Ok(both) => both,
            Err(reason) => {
                unread.push(reason);
                continue;
            }
        };
        let n = f64::from(truth.width()) * f64::from(truth.height());
        both += found.overlap(&truth) as f64;
        either += found.or(&truth).count() as f64;
        photos.push(TransientScore {
            photo: photo.clone(),
            iou: if found.is_empty() && truth.is_empty() { 1.0 } else { found.iou(&truth) },
            covered: truth.count() as f64 / n,
            false_share: found.minus(&truth).count() as f64 / n,
        });
    }
    if photos.is_empty() {
        let mut reason = format!(
            "--transient-masks {}: it holds no true mask of a photo of this run whose transients were looked for",
            truth.display()
        );
        if let Some(first) = unread.first() {
            reason += &format!("; {} could not be read, the first: {first}", unread.len());
        }
        return Err(RunError::Input(reason));
    }
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len().max(1) as f64;
    Ok(TransientScores {
        iou: mean(photos.iter().filter(|p| p.covered > 0.0).map(|p| p.iou).collect()),
        pooled_iou: if either > 0.0 { both / either } else { 1.0 },
        false_share: mean(photos.iter().map(|p| p.false_share).collect()),
        photos,
        unread,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{Camera, Frame, Photo, Pose, Seal};

    fn view(photo: &Path) -> View {
        let name = photo.file_name().unwrap().to_string_lossy().into_owned();
        let photo = Photo {
            path: photo.to_owned(),
            ignore: None,
            usable: None,
            lens: None,
            seal: Seal::default(),
            reading: Default::default(),
        };
        let camera = Camera { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
        let pose = Pose::look_at(glam::Vec3::NEG_Z, glam::Vec3::ZERO, glam::Vec3::NEG_Y);
        View { name, camera, pose, photo, test: false }
    }

    #[test]
    fn one_unusable_mask_of_a_named_folder_leaves_out_that_photo_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let views = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"].map(|name| view(&dir.path().join(name))).to_vec();
        let frame = Frame { origin: Default::default(), scale: 1.0 };
        let scene = Scene { views, points: Vec::new(), skipped: Vec::new(), notes: Vec::new(), frame };
        let (named, run) = (dir.path().join("named"), RunFolder::create(&dir.path().join("run")).unwrap());
        std::fs::create_dir(&named).unwrap();
        Mask::full(40, 30).write_png(&named.join("a.png")).unwrap();
        Mask::full(50, 50).write_png(&named.join("b.png")).unwrap();
        std::fs::write(named.join("c.png"), b"no picture").unwrap();
        let found = Corrections::find(&scene, &run, &named.to_string_lossy()).unwrap();
        let reasons: Vec<(usize, &str)> =
            found.unusable().iter().map(|(i, why)| (*i, why.as_str())).collect();
        assert!(
            matches!(reasons[..], [(1, b), (2, c)] if b.contains("b.png: it has 50 x 50") && c.contains("c.png")),
            "{reasons:?}"
        );
        let digests: Vec<bool> = (0..4).map(|view| found.digest(view).is_some()).collect();
        assert_eq!(digests, [true, false, false, false]);
    }

    #[test]
    fn a_mask_of_everything_and_one_of_nothing_are_named() {
        let words = |mask: &Mask, psnr| odd("a.jpg", "a.png", mask, psnr);
        let all = words(&Mask::full(40, 30), 20.0).expect("all of it");
        assert!(all.contains("a.jpg") && all.contains("100 %") && all.contains("transients/a.png"), "{all}");
        let none = words(&Mask::empty(40, 30), 9.0).expect("nothing, and it does not fit");
        assert!(none.contains("a.jpg") && none.contains("9.0 dB"), "{none}");
        assert!(words(&Mask::empty(40, 30), 25.0).is_none(), "it fits, and nobody stands before it");
        assert!(words(&Mask::from_fn(40, 30, |x, _| x < 8), 9.0).is_none(), "transients explain it");
    }

    #[test]
    fn the_same_pixels_in_another_file_are_the_same_mask() {
        let dir = tempfile::tempdir().unwrap();
        let mask = Mask::from_fn(13, 7, |x, y| (x + y) % 3 == 0);
        // An editor writes colours and other bytes.
        let picture = segwild_scene::Image {
            width: 13,
            height: 7,
            channels: 3,
            data: (0..3 * 91).map(|i| f32::from(u8::from(mask.index(i % 91)))).collect(),
        };
        let file = dir.path().join("a.png");
        picture.write_png(&file).unwrap();
        assert_eq!(pixels(&Mask::read_png(&file).unwrap()), pixels(&mask));
        assert_ne!(pixels(&mask.not()), pixels(&mask));
    }
}
