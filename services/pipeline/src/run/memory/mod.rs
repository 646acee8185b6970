//! Estimates the memory of a run before it starts.
//!
//! Only indexes (names, keys, cameras, points) grow with the number of photos: photos, embeddings, masks and renders
//! are read when they are needed and pass through bounded mailboxes. The memory is proportional to the splats and to
//! the size of one photo, plus four caches with limits of their own, which shrink to fit the budget.

mod blocks;

pub(crate) use blocks::{blocks_in_words, with_blocks};

use crate::{RunError, Settings};
use segwild_flow::codec::SIZE_LIMIT;
use segwild_objective::{EmbedAppearance, GswAppearance};
use segwild_scene::{Scene, View};
use segwild_trainer::{AppearanceModel, LpipsNet, TrainSettings, splat_cap, stereo_bytes, trained_share};
use std::fmt;

/// MiB of the program itself, its threads, SQLite and the report's images.
const BASE: f64 = 70.0;
/// Bytes of all indexes per photo: names, keys, cameras, ledger rows, spans of the timeline.
const PER_PHOTO: f64 = 12_000.0;
/// Bytes per observation of a reconstructed point, as read and as the trainer sorts it.
const PER_OBSERVATION: f64 = 60.0;
/// Copies of a splat's parameters that are held at most: they and Adam's two moments in the trainer and in a checkpoint,
/// gradients, snapshot; and space for the scene tree, which grows when most of those are freed.
const COPIES: f64 = 12.0;
/// The same of a splat that is rendered and not trained, in a training by blocks: it has no moments.
const FROZEN_COPIES: f64 = 5.0;
/// Copies of a splat's parameters in a checkpoint: they and Adam's two moments.
const CHECKPOINT_COPIES: f64 = 3.0;
/// The same as [`COPIES`] for imported splats: the file's bytes, the splats as read and as placed, the model, and one in
/// reserve.
const IMPORT_COPIES: f64 = 5.0;
/// Bytes per splat beside its parameters: projection, statistics.
const PER_SPLAT: f64 = 200.0;
/// Copies of a splat's features: values, Adam's moments, gradients.
const FEATURE_COPIES: f64 = 5.0;
/// Floats per pixel of a photo that all actors together hold while they work, including the one photo that each cache
/// always keeps. Fitted to runs at 640 px.
const PER_PIXEL: f64 = 200.0;
/// The same for each further photo that the masks and features actors work on at once: `liberty` at 640 px takes 38 to
/// 54 MiB for each on two cores, 80 to 87 on 16.
const PER_FURTHER_PHOTO: f64 = 85.0;
/// Bytes per pixel at the training size that decoding a photo of about that size takes. [`PER_PIXEL`] and
/// [`PER_FURTHER_PHOTO`] include them.
const DECODED: u64 = 8;
/// Bytes from which on a file of LPIPS weights is VGG-16's: they take 29 MB as 16-bit numbers, AlexNet's 10 MB as F32.
const OF_VGG: u64 = 20 << 20;
/// Least MiB that each of the caches is given.
const LEAST_CACHE: usize = 8;
/// MiB of the process per MiB in a cache: the allocator's blocks are larger than their content, and not every freed
/// block goes back to the system. Measured on runs of `liberty` and `sacre_coeur`.
const PER_CACHED: f64 = 1.25;

const MIB: f64 = (1 << 20) as f64;

/// How much memory a run takes, in MiB.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryNeed {
    /// The least that it needs: a smaller memory budget is refused.
    pub least_mib: u32,
    /// The most that it uses: with every cache as large as the settings allow.
    pub most_mib: u32,
    splats: usize,
    size: u32,
}

/// The least need with its cause: `153 MiB of memory for 16580 splats and photos of 320 px`.
impl fmt::Display for MemoryNeed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let MemoryNeed { least_mib, splats, size, .. } = self;
        write!(f, "{least_mib} MiB of memory for {splats} splats and photos of {size} px")
    }
}

fn need(settings: &Settings, scene: &Scene) -> MemoryNeed {
    let with = |fixed: f64, caches: usize| (fixed + caches as f64 * PER_CACHED).ceil() as u32;
    let alone = with_one_photo(settings, scene) + most_decoding(settings, scene) as f64 / MIB;
    let all = alone + (settings.most_photos_at_once() - 1) as f64 * further_photo(settings, scene);
    // The analyses of photos are held to the end. The trainer's photos are freed before the feature field is made.
    let caches = (settings.vision.vision_memory + settings.run.photo_memory) as usize
        + settings.train.photo_cache_mib.max(settings.features.feature_memory as usize);
    let least_mib = with(alone, 2 * LEAST_CACHE);
    MemoryNeed {
        least_mib,
        most_mib: with(all, caches).max(least_mib),
        splats: most_splats(settings, scene),
        size: settings.scene.size,
    }
}

/// Photos that an actor works on at once beside the training: as many as there are cores for. Under a memory budget
/// they may take half of what is left for them and the caches, so that they may be fewer.
pub(crate) fn photos_at_once(settings: &Settings, scene: &Scene) -> usize {
    let (most, budget) = (settings.most_photos_at_once(), f64::from(settings.run.memory_budget));
    if budget == 0.0 {
        return most;
    }
    let left = budget - with_decoding(settings, scene) - 2.0 * LEAST_CACHE as f64 * PER_CACHED;
    let more = 0.5 * left.max(0.0) / further_photo(settings, scene).max(1e-3);
    most.min(1 + more as usize)
}

/// MiB that each photo but the first takes.
fn further_photo(settings: &Settings, scene: &Scene) -> f64 {
    pixels(settings, scene) as f64 * 4.0 * PER_FURTHER_PHOTO / MIB
}

/// Bytes that decoding the photo takes beyond those counted for its pixels at the training size.
fn decoding(settings: &Settings, view: &View) -> u64 {
    let camera = view.camera.scaled_to(settings.scene.size);
    let counted = DECODED * u64::from(camera.width) * u64::from(camera.height);
    view.photo.reading.bytes.saturating_sub(counted)
}

/// The same for the photo that takes most.
fn most_decoding(settings: &Settings, scene: &Scene) -> u64 {
    scene.views.iter().map(|view| decoding(settings, view)).max().unwrap_or(0)
}

/// Bytes that decoding a photo may take under the memory budget; photos that take more are left out. `None` without a
/// budget.
pub(crate) fn decoding_limit(settings: &Settings, scene: &Scene) -> Option<u64> {
    let budget = f64::from(settings.run.memory_budget);
    let least = with_one_photo(settings, scene) + 2.0 * LEAST_CACHE as f64 * PER_CACHED;
    (budget > 0.0).then(|| ((budget - least).max(0.0) * MIB) as u64)
}

/// A photo whose decoding does not fit into the memory budget.
#[derive(Clone, Copy, Debug, thiserror::Error)]
#[error(
    "decoding its file takes {} MiB of memory, and --memory-budget {budget} leaves {} for it: give {} MiB, or make the photo smaller",
    mib(*bytes),
    mib(*limit),
    u64::from(*budget) + mib(bytes - limit)
)]
pub(crate) struct TooLargePhoto {
    /// Bytes that its decoding takes.
    bytes: u64,
    /// Bytes that the budget leaves for it.
    limit: u64,
    /// The budget in MiB.
    budget: u32,
}

fn mib(bytes: u64) -> u64 {
    bytes.div_ceil(1 << 20)
}

/// Refuses a photo that is left out under the memory budget. `limit` is [`decoding_limit`]'s, in bytes.
///
/// # Errors
/// When its decoding takes more.
pub(crate) fn fits_budget(settings: &Settings, view: &View, limit: Option<u64>) -> Result<(), TooLargePhoto> {
    let bytes = decoding(settings, view);
    match limit.filter(|&limit| bytes > limit) {
        None => Ok(()),
        Some(limit) => Err(TooLargePhoto { bytes, limit, budget: settings.run.memory_budget }),
    }
}

/// MiB that a run takes beside the caches.
fn fixed(settings: &Settings, scene: &Scene) -> f64 {
    with_decoding(settings, scene)
        + (photos_at_once(settings, scene) - 1) as f64 * further_photo(settings, scene)
}

/// MiB with one photo at once, and with the decoding of the largest photo that is not left out.
fn with_decoding(settings: &Settings, scene: &Scene) -> f64 {
    let limit = decoding_limit(settings, scene).unwrap_or(u64::MAX);
    let most = scene.views.iter().map(|view| decoding(settings, view)).filter(|&bytes| bytes <= limit).max();
    with_one_photo(settings, scene) + most.unwrap_or(0) as f64 / MIB
}

/// The most splats that there can be.
fn most_splats(settings: &Settings, scene: &Scene) -> usize {
    match &scene.imported {
        Some(imported) => imported.file.splats,
        None => splat_cap(&settings.train, scene, settings.scene.size),
    }
}

fn with_one_photo(settings: &Settings, scene: &Scene) -> f64 {
    let splats = most_splats(settings, scene) as f64;
    let (degree, copies) = match &scene.imported {
        Some(imported) => (imported.file.sh_degree, IMPORT_COPIES),
        None => {
            let trained = trained_share(scene, settings.train.blocks);
            (settings.train.sh_degree, FROZEN_COPIES + trained * (COPIES - FROZEN_COPIES))
        }
    };
    let bands = f64::from((degree + 1).pow(2));
    let training = 4.0 * (11.0 + 3.0 * bands) * copies + PER_SPLAT;
    let (embedding, appearance) = appearance_memory(&settings.train, scene.views.len());
    let training = training + 4.0 * embedding * copies;
    let field = 4.0 * f64::from(settings.features.channels) * FEATURE_COPIES + 4.0 * (11.0 + 3.0 * bands);
    let samples = f64::from(settings.features.pca_samples) * 4.0 * 64.0;
    let observations: usize = scene.points.iter().map(|p| p.track.len()).sum();
    let stereo = stereo_bytes(&settings.train, scene.views.len(), pixels(settings, scene));
    let bytes = (splats * training.max(field)).max(stereo as f64)
        + pixels(settings, scene) as f64 * 4.0 * PER_PIXEL
        + samples
        + appearance
        + lpips_memory(settings, pixels(settings, scene)) as f64
        + scene.views.len() as f64 * PER_PHOTO
        + observations as f64 * PER_OBSERVATION;
    BASE + bytes / MIB
}

/// Memory of the appearance model: floats per splat, and bytes for all photos together.
fn appearance_memory(train: &TrainSettings, photos: usize) -> (f64, f64) {
    match train.appearance_model {
        AppearanceModel::None | AppearanceModel::Affine => (0.0, 0.0),
        // The largest model that `auto` may choose.
        AppearanceModel::Embed | AppearanceModel::Auto => (EmbedAppearance::EMBEDDING_SIZE as f64, 0.0),
        AppearanceModel::Gsw => {
            // Photos are kept once, and once more while a checkpoint is written.
            let photos = 2.0 * photos as f64 * GswAppearance::photo_bytes(train.gsw_width) as f64;
            let networks = 4.0 * GswAppearance::weights(train.gsw_width) as f64 * COPIES;
            (GswAppearance::EMBEDDING_SIZE as f64, photos + networks)
        }
    }
}

/// Bytes of LPIPS, where its weights are given: it scores held-out photos, and may be in the loss.
fn lpips_memory(settings: &Settings, pixels: usize) -> usize {
    if settings.run.lpips_weights.is_empty() {
        return 0;
    }
    // The file is read later, and refused if it holds no weights.
    let length = std::fs::metadata(&settings.run.lpips_weights).map_or(0, |data| data.len());
    let net = if length < OF_VGG { LpipsNet::Alex } else { LpipsNet::Vgg };
    net.bytes(pixels, settings.train.lambda_lpips > 0.0)
}

/// Refuses a training that takes more of an accelerator's memory than the budget allows, or an array longer than so many bytes, the
/// longest that it can use.
///
/// # Errors
/// In words, with the numbers.
pub(crate) fn fits_accelerator(
    settings: &Settings,
    scene: &Scene,
    longest_array: u64,
) -> Result<(), RunError> {
    let budget = settings.run.memory_budget;
    if scene.imported.is_some() {
        // They are rendered, not trained, in buffers that the engine keeps within the budget.
        return Ok(());
    }
    // Blocks are trained from the host, and rendered like imported splats. The whole scene is trained before, by few
    // splats.
    let splats = splat_cap(&settings.train, scene, settings.scene.size) / settings.train.blocks.max(1);
    let (embedding_size, networks) = match settings.train.appearance_model {
        AppearanceModel::None | AppearanceModel::Affine => (0, None),
        // `auto` may choose it.
        AppearanceModel::Embed | AppearanceModel::Auto => (EmbedAppearance::EMBEDDING_SIZE, None),
        AppearanceModel::Gsw => (GswAppearance::EMBEDDING_SIZE, Some(settings.train.gsw_width)),
    };
    let (pixels, size) = (pixels(settings, scene), settings.scene.size);
    let longest = segwild_gpu::longest_of_photo(pixels);
    if longest > longest_array {
        return Err(RunError::Request(format!(
            "training on photos of {size} px takes arrays of {} MiB, and the accelerator can use none longer than {}: lower \
             --size, or take --engine cpu",
            mib(longest),
            longest_array >> 20
        )));
    }
    let bytes =
        segwild_gpu::training_bytes(splats, pixels, settings.train.sh_degree, embedding_size, networks);
    let need = ((bytes + segwild_gpu::LEAST_PHOTOS) as f64 / MIB).ceil() as u32;
    if budget == 0 || need <= budget {
        return Ok(());
    }
    Err(RunError::Request(format!(
        "training {splats} splats on photos of {size} px takes about {need} MiB of the accelerator's memory, and \
         --memory-budget allows {budget}: give more, lower --splats or --size, train it in several --blocks, or \
         take --engine cpu"
    )))
}

/// Refuses more splats than a record of the run can hold: the first checkpoint could not be written.
///
/// # Errors
/// In words, with the numbers.
pub(crate) fn fits_records(settings: &Settings, scene: &Scene) -> Result<(), RunError> {
    let (degree, embedding, copies) = match &scene.imported {
        Some(imported) => (imported.file.sh_degree, 0.0, 1.0),
        None => {
            let (embedding, _) = appearance_memory(&settings.train, scene.views.len());
            let trained = trained_share(scene, settings.train.blocks);
            (settings.train.sh_degree, embedding, 1.0 + trained * (CHECKPOINT_COPIES - 1.0))
        }
    };
    let parameters = 11.0 + 3.0 * f64::from((degree + 1).pow(2)) + embedding;
    let (of_training, of_features) = (parameters * copies, f64::from(settings.features.channels));
    let numbers = of_training.max(of_features);
    let (splats, most) = (most_splats(settings, scene), SIZE_LIMIT as f64);
    let bytes = 4.0 * numbers * splats as f64;
    if bytes <= most {
        return Ok(());
    }
    let lower = if of_features > of_training { "--channels or --splats" } else { "--splats" };
    Err(RunError::Request(format!(
        "{splats} splats take {:.0} MiB of one file of the run, which holds at most {:.0} MiB: lower {lower}, or \
         import fewer",
        bytes / MIB,
        most / MIB
    )))
}

/// Pixels of the largest photo.
fn pixels(settings: &Settings, scene: &Scene) -> usize {
    let cameras = scene.views.iter().map(|v| v.camera.scaled_to(settings.scene.size));
    cameras.map(|camera| camera.width as usize * camera.height as usize).max().unwrap_or(0)
}

/// Whether a run fits in the memory budget with the least caches, but for a few photos whose decoding does not.
fn fits(settings: &Settings, scene: &Scene) -> bool {
    let budget = settings.run.memory_budget as usize;
    if budget == 0 || need(settings, scene).least_mib as usize <= budget {
        return true;
    }
    let limit = decoding_limit(settings, scene);
    let photo_fits = |view: &&View| fits_budget(settings, view, limit).is_ok();
    let most_fit = 2 * scene.views.iter().filter(photo_fits).count() > scene.views.len();
    let dearest = with_decoding(settings, scene) + 2.0 * LEAST_CACHE as f64 * PER_CACHED;
    most_fit && dearest.ceil() as usize <= budget
}

/// The settings with caches that fit the memory budget, if there is one. Also limits the memory of all decoding in this
/// process.
///
/// # Errors
/// In words, with the numbers, when the rest alone does not fit. A few photos whose decoding does not fit are no error:
/// they are left out ([`fits_budget`]).
pub(crate) fn within_budget(settings: &Settings, scene: &Scene) -> Result<Settings, RunError> {
    let mut settings = settings.clone();
    let budget = settings.run.memory_budget as usize;
    segwild_scene::limit_decoding(None);
    if budget == 0 {
        return Ok(settings);
    }
    if !fits(&settings, scene) {
        let need = need(&settings, scene);
        return Err(RunError::Request(format!(
            "this run needs about {need}, and --memory-budget allows {budget}: give more, or lower --splats or --size"
        )));
    }
    // A network takes about the size of its file, which is not known here: it may take at most the whole budget.
    settings.vision.network_memory = settings.vision.network_memory.min(settings.run.memory_budget);
    // Several photos are decoded at once where the budget allows it.
    let (alone, least) = (fixed(&settings, scene), 2.0 * LEAST_CACHE as f64 * PER_CACHED);
    let one = (with_decoding(&settings, scene) - with_one_photo(&settings, scene)) * MIB;
    let more = (budget as f64 - alone - least).max(0.0) * MIB / 4.0;
    let more = more.min(one * (settings.most_photos_at_once() - 1) as f64);
    let counted =
        (DECODED * pixels(&settings, scene) as u64) as f64 * photos_at_once(&settings, scene) as f64;
    segwild_scene::limit_decoding(Some((one + more + counted) as u64));
    let for_caches = ((budget as f64 - alone - more / MIB) / PER_CACHED) as usize;
    // Photos can be decoded again: the caches of what is dear have their least first.
    let photos = for_caches.saturating_sub(2 * LEAST_CACHE) / 4;
    settings.run.photo_memory = settings.run.photo_memory.min(photos as u32);
    let for_caches = for_caches - settings.run.photo_memory as usize;
    settings.vision.vision_memory = settings.vision.vision_memory.min((for_caches / 2) as u32);
    let rest = for_caches - settings.vision.vision_memory as usize;
    settings.train.photo_cache_mib = settings.train.photo_cache_mib.min(rest);
    settings.features.feature_memory = settings.features.feature_memory.min(rest as u32);
    Ok(settings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use segwild_scene::{Camera, Photo, Pose, Reading, View};

    #[test]
    fn a_budget_is_shared_by_every_cache_that_is_held_at_the_same_time() {
        let scene = Scene::new(vec![], vec![]);
        let mut settings = Settings::default();
        settings.train.splats = 1000;
        let MemoryNeed { least_mib, most_mib, .. } = need(&settings, &scene);
        settings.run.memory_budget = least_mib + 40;
        let fitted = within_budget(&settings, &scene).expect("it fits");
        let vision = fitted.vision.vision_memory as usize;
        for other in [fitted.train.photo_cache_mib, fitted.features.feature_memory as usize] {
            assert!(
                vision >= LEAST_CACHE && other >= LEAST_CACHE && vision + other <= 2 * LEAST_CACHE + 32,
                "{vision} {other}"
            );
        }
        settings.run.memory_budget = most_mib;
        let roomy = within_budget(&settings, &scene).expect("it fits");
        assert_eq!((&roomy.train, &roomy.features), (&settings.train, &settings.features), "nothing is cut");
        settings.run.memory_budget = least_mib - 1;
        let refused = within_budget(&settings, &scene).expect_err("too little").to_string();
        assert!(
            refused.contains(&format!("{least_mib} MiB")) && refused.contains("1000 splats"),
            "{refused}"
        );
    }

    #[test]
    fn a_budget_holds_fewer_photos_at_once() {
        let camera = Camera { width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };
        let photo = Photo::new("a.jpg");
        let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
        let view = View { name: "a.jpg".into(), camera, pose, photo, test: false };
        let scene = Scene::new(vec![view], vec![]);
        let mut settings = Settings::default();
        settings.run.threads = 16;
        let MemoryNeed { least_mib, most_mib, .. } = need(&settings, &scene);
        assert_eq!(photos_at_once(&settings, &scene), 8, "no budget");
        let mut before = 1;
        for budget in least_mib..=2 * most_mib {
            settings.run.memory_budget = budget;
            let now = photos_at_once(&settings, &scene);
            assert!(now >= before && now <= 8 && (budget > least_mib + 100 || now == 1), "{budget}: {now}");
            let fitted = within_budget(&settings, &scene).expect("it fits");
            assert_eq!(photos_at_once(&fitted, &scene), now);
            before = now;
        }
        assert_eq!(before, 8);
    }

    #[test]
    fn a_training_larger_than_an_accelerators_memory_is_refused_with_its_size() {
        let scene = Scene::new(vec![], vec![]);
        let mut settings = Settings::default();
        settings.train.splats = 1_000_000;
        assert!(fits_accelerator(&settings, &scene, u64::MAX).is_ok(), "no budget");
        settings.run.memory_budget = 1000;
        let refused = fits_accelerator(&settings, &scene, u64::MAX).expect_err("too little").to_string();
        for word in ["1000000 splats", "--memory-budget allows 1000", "--engine cpu"] {
            assert!(refused.contains(word), "{refused}");
        }
        settings.run.memory_budget = 8000;
        assert!(fits_accelerator(&settings, &scene, u64::MAX).is_ok());
    }

    #[test]
    fn photos_too_large_for_an_accelerators_arrays_are_refused_before_the_training() {
        let camera = Camera { width: 4000, height: 3000, fx: 3e3, fy: 3e3, cx: 2e3, cy: 1.5e3 };
        let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
        let view = View { name: "a.jpg".into(), camera, pose, photo: Photo::new("a.jpg"), test: false };
        let (scene, mut settings) = (Scene::new(vec![view], vec![]), Settings::default());
        // The least that WebGPU promises.
        let fits = |settings: &Settings| fits_accelerator(settings, &scene, 128 << 20);
        settings.scene.size = 1600;
        assert!(fits(&settings).is_ok());
        settings.scene.size = 4000;
        let refused = fits(&settings).expect_err("too large").to_string();
        for word in ["4000 px", "412 MiB", "none longer than 128", "--size", "--engine cpu"] {
            assert!(refused.contains(word), "{refused}");
        }
    }

    #[test]
    fn five_million_splats_fit_a_checkpoint_and_more_than_fit_are_refused_before_the_training() {
        let scene = Scene::new(vec![], vec![]);
        let mut settings = Settings::default();
        settings.train.splats = 5_000_000;
        fits_records(&settings, &scene).expect("five million splats can be stored");
        settings.train.splats = 20_000_000;
        let refused = fits_records(&settings, &scene).expect_err("too many").to_string();
        for word in ["20000000 splats", "at most 8192 MiB", "--splats"] {
            assert!(refused.contains(word), "{refused}");
        }
        assert!(!refused.contains("--channels"), "the training takes more: {refused}");
        // A field of as many channels as there are takes more than the training.
        settings.train.splats = 10_000_000;
        settings.features.channels = 256;
        let refused = fits_records(&settings, &scene).expect_err("too many").to_string();
        assert!(refused.contains("--channels or --splats"), "{refused}");
    }

    #[test]
    fn a_budget_is_not_overrun_by_what_the_allocator_adds_to_the_caches() {
        let scene = Scene::new(vec![], vec![]);
        let mut settings = Settings::default();
        settings.run.memory_budget = need(&settings, &scene).least_mib + 100;
        let fitted = within_budget(&settings, &scene).expect("it fits");
        let caches = fitted.vision.vision_memory as usize
            + fitted.train.photo_cache_mib.max(fitted.features.feature_memory as usize);
        let most = fixed(&settings, &scene) + caches as f64 * PER_CACHED;
        assert!(most <= f64::from(settings.run.memory_budget), "{most}");
    }

    #[test]
    fn a_photo_whose_decoding_breaks_the_budget_is_left_out_and_many_are_refused_with_the_number() {
        let camera = Camera { width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };
        let view = |i: usize, mib: u64| {
            let reading = Reading { bytes: mib << 20, ..Default::default() };
            let name = format!("{i}.jpg");
            let photo = Photo { reading, ..Photo::new(&name) };
            let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
            View { name, camera, pose, photo, test: false }
        };
        let of = |mib: [u64; 4]| {
            let views = mib.into_iter().enumerate().map(|(i, mib)| view(i, mib)).collect();
            Scene::new(views, vec![])
        };
        let mut settings = Settings::default();
        settings.run.threads = 2;
        let least = |scene: &Scene| need(&Settings { ..settings.clone() }, scene).least_mib;
        let (small, large) = (of([1; 4]), of([500; 4]));
        let more = least(&large) - least(&small);
        assert!((490..=500).contains(&more), "files count: {more}");
        let mut tight = settings.clone();
        tight.run.memory_budget = least(&small) + 20;
        let one = of([1, 500, 1, 1]);
        let limit = decoding_limit(&tight, &one);
        let fit: Vec<_> = one.views.iter().map(|view| fits_budget(&tight, view, limit)).collect();
        assert_eq!(fit.iter().map(Result::is_ok).collect::<Vec<_>>(), [true, false, true, true]);
        let words = fit[1].expect_err("it is too large").to_string();
        assert!(words.contains("MiB") && words.contains("--memory-budget"), "{words}");
        within_budget(&tight, &one).expect("the rest goes on");
        let refused = within_budget(&tight, &large).expect_err("none fits").to_string();
        assert!(refused.contains(&format!("{} MiB", least(&large))), "{refused}");
        tight.run.memory_budget = least(&large);
        within_budget(&tight, &large).expect("with the number that was named");
        segwild_scene::limit_decoding(None);
    }
}
