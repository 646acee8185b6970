//! `--time`: what a time buys on this machine. It is decided once, before the training, and kept in the run's cache, so that a
//! run that continues, here or elsewhere, goes on with the same steps and splats.

use super::choice::{held_photos, kept};
use super::memory;
use crate::artifacts::auto_choice::AutoChoice;
use crate::artifacts::keys::Keys;
use crate::{RunBudget, RunError, Settings};
use rayon::prelude::*;
use segwild_flow::{Cache, CacheError, Key};
use segwild_masks::{MaskSource, generate, sasm};
use segwild_objective::Engine;
use segwild_scene::{Image, PhotoStore, Scene};
use segwild_trainer::{Lpips, TimeBounds, TimeChoice, TimeModel, TrainError, measure_steps};
use segwild_vision::Providers;
use std::sync::Arc;
use std::time::Instant;

/// What stands for the engine in the key: a run that another engine continues keeps what was decided.
pub(crate) const ANY_ENGINE: &str = "any";

/// Photos whose masks and descriptors are made to measure that, at most.
const MEASURED: usize = 8;

/// Refuses a time that has nothing to decide, or that something else decides. `recorded` is the number of blocks of the training
/// in the run folder.
///
/// # Errors
/// In words.
pub(crate) fn fits_time(scene: &Scene, settings: &Settings, recorded: Option<usize>) -> Result<(), RunError> {
    let (time, train) = (settings.run.time, &settings.train);
    if time.is_none() {
        return Ok(());
    }
    let refused = |words: String| Err(RunError::Request(words));
    if scene.imported.is_some() {
        return refused(format!(
            "--time {time} decides how long splats are trained, and imported ones stay as they are: leave it out"
        ));
    }
    if train.steps > 0 && train.splats > 0 {
        return refused(format!(
            "--time {time} has nothing to decide: --steps {} and --splats {} are both set; leave one of them open (0)",
            train.steps, train.splats
        ));
    }
    if train.steps == 0 && train.effort != settings.run.preset.settings().effort {
        return refused(format!(
            "--time {time} and --effort {} both decide the steps: leave out one of them",
            train.effort
        ));
    }
    let blocks = memory::with_blocks(settings, scene, recorded).train.blocks;
    if blocks > 1 {
        return refused(format!(
            "--time {time} estimates a training of the whole scene at once, and this one has {blocks} blocks: give \
             --steps instead, or --blocks 1 and the memory that it needs"
        ));
    }
    Ok(())
}

/// The key of what a time decides. `choice` is the key of all that is chosen before the training ([`Keys::choice`]) of a run
/// with these settings on [`ANY_ENGINE`].
fn time_key(settings: &Settings, choice: &Key) -> Key {
    Key::of(TimeChoice::KIND)
        .value("rule", TimeChoice::RULE)
        .key("choice", choice)
        .value("seconds", settings.run.time.seconds())
        .value("budget", settings.run.budget)
        .finish()
}

/// What the time of these settings has bought before; `None` where it is not decided, or there is none.
///
/// # Errors
/// When the cache cannot be read.
pub(crate) fn time_before(
    cache: &Cache,
    settings: &Settings,
    choice: &Key,
) -> Result<Option<TimeChoice>, CacheError> {
    if !TimeChoice::is_open(settings) {
        return Ok(None);
    }
    kept(cache, &time_key(settings, choice))
}

/// What the time of these settings buys, and its key: as it was decided before, or as `decide` says, which is kept.
///
/// # Errors
/// As `decide`; when the cache cannot be read or written.
pub(crate) fn decided_once(
    cache: &Cache,
    settings: &Settings,
    choice: &Key,
    decide: impl FnOnce() -> Result<TimeChoice, RunError>,
) -> Result<(Key, TimeChoice), RunError> {
    let key = time_key(settings, choice);
    if let Some(before) = time_before(cache, settings, choice)? {
        return Ok((key, before));
    }
    let now = decide()?;
    let text = serde_json::to_string(&now).unwrap_or_default();
    cache.put_typed(&key, TimeChoice::KIND, &text)?;
    Ok((key, now))
}

/// What is measured of this machine.
pub(crate) struct TimeMeasurement<'a> {
    pub scene: &'a Arc<Scene>,
    pub engine: &'a Arc<dyn Engine>,
    pub providers: &'a Providers,
    /// Weights of LPIPS, if the settings name any.
    pub lpips: Option<&'a Arc<Lpips>>,
    /// The keys of a run with the settings that are measured.
    pub keys: &'a Keys,
    /// Whether the steps were left to the scene.
    pub steps_open: bool,
    /// Ends the work.
    pub stopping: &'a dyn Fn() -> bool,
}

impl TimeMeasurement<'_> {
    /// What the time of these settings buys of a run that has taken as long as `spent_s` returns, when everything is measured.
    /// The appearance model of the settings is decided.
    ///
    /// # Errors
    /// In words, when the time does not suffice; when the scene cannot be trained, or the run is stopped.
    pub fn choose(&self, settings: &Settings, spent_s: &dyn Fn() -> f64) -> Result<TimeChoice, RunError> {
        let budget = settings.run.budget == RunBudget::Auto;
        let bounds = TimeBounds::of(self.scene, &settings.train, self.steps_open, budget);
        let model = self.model(settings)?;
        TimeChoice::of(settings.run.time, spent_s(), model, &bounds)
            .map_err(|little| RunError::Request(format!("--time: {little} (--size)")))
    }

    fn model(&self, settings: &Settings) -> Result<TimeModel, RunError> {
        let size = settings.scene.size;
        let photos = held_photos(self.scene, &self.providers.sky, self.keys.refused(), size);
        let (scene, train) = (&**self.scene, &settings.train);
        let speed = measure_steps(self.engine, scene, &photos, train, self.lpips, self.stopping).map_err(
            |error| match error {
                TrainError::Stopped => RunError::Interrupted,
                error => RunError::Stage { stage: "geometry", reason: error.to_string() },
            },
        )?;
        let described: Vec<usize> = (0..scene.views.len())
            .filter(|&v| {
                !scene.views[v].test && self.keys.unreadable(v).is_none() && self.keys.is_described(v)
            })
            .collect();
        let of_photos = self.photo_seconds(settings, &described)?;
        let refine_steps = settings.features.refine_steps;
        Ok(TimeModel::new(speed, scene, train, refine_steps, described.len(), of_photos))
    }

    /// Seconds in which a photo is decoded with its sky, and in which its descriptors and masks are made, with as many photos at
    /// once as in a run. A photo that a model fails on counts with the time that this took: the run names it.
    fn photo_seconds(&self, settings: &Settings, described: &[usize]) -> Result<[f64; 2], RunError> {
        let at_once = memory::photos_at_once(settings, self.scene).clamp(1, MEASURED);
        let every = described.len().div_ceil(at_once).max(1);
        let views: Vec<usize> = described.iter().copied().step_by(every).collect();
        if views.is_empty() {
            return Ok([0.0; 2]);
        }
        let (scene, providers) = (&**self.scene, self.providers);
        let store = PhotoStore::new(self.scene.clone(), settings.scene.size, 0);
        // A network is loaded at its first use, which is no photo's time.
        let small = Image::filled(64, 48, 3, 0.5);
        let _ = providers.sky.sky(&small);
        let _ = providers.embedder.embed(&small);
        let _ = providers.proposer.propose(&small, &[[32.0, 24.0]]);
        self.go_on()?;
        let began = Instant::now();
        let images: Vec<Image> = views
            .par_iter()
            .filter_map(|&view| {
                let photo = store.read(view).ok()?;
                let seen = scene.points_in(view, photo.image.width, photo.image.height);
                let _ = providers.sky.sky_above(&photo.image, &seen);
                Some(photo.image.clone())
            })
            .collect();
        let photo_s = began.elapsed().as_secs_f64() / views.len() as f64;
        self.go_on()?;
        let began = Instant::now();
        images.par_iter().for_each(|image| {
            let _ = providers.embedder.embed(image);
            let budget = settings.masks.prompt_budget;
            let prompts = sasm::uniform_prompts(image.width as u32, image.height as u32, budget);
            // Masks are made of renders, which a model has not seen, unless they are to be made of photos.
            let unseen = (settings.masks.mask_source == MaskSource::Render).then(|| turned(image));
            let image = unseen.as_ref().unwrap_or(image);
            let _ = generate(&*providers.proposer, image, &prompts, None, &settings.masks);
        });
        let described_s = began.elapsed().as_secs_f64() / images.len().max(1) as f64;
        self.go_on()?;
        Ok([photo_s, described_s])
    }

    fn go_on(&self) -> Result<(), RunError> {
        if (self.stopping)() { Err(RunError::Interrupted) } else { Ok(()) }
    }
}

/// The image upside down.
fn turned(image: &Image) -> Image {
    let planes = image.data.chunks(image.pixels().max(1));
    let data = planes.flat_map(|plane| plane.iter().rev().copied()).collect();
    Image { data, ..*image }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::WallTime;
    use segwild_trainer::{Preset, StepSpeed, TrainSettings};

    fn scene() -> Scene {
        Scene::new(vec![], vec![])
    }

    fn with_time(seconds: u32) -> Settings {
        let mut settings = Settings::default();
        settings.run.time = WallTime::of(seconds);
        settings
    }

    /// What a machine that takes so many seconds for a step buys.
    fn on_machine(settings: &Settings, step_s: f64) -> TimeChoice {
        let speed =
            StepSpeed { base_s: step_s, per_splat_s: 0.0, half_share: 0.3, pixels: 76_800, splats: 9000 };
        let model = TimeModel::new(speed, &scene(), &settings.train, 60, 0, [0.0; 2]);
        let bounds = TimeBounds { steps: (100, 10_000), splats_open: true };
        TimeChoice::of(settings.run.time, 1.0, model, &bounds).expect("it suffices")
    }

    #[test]
    fn a_run_that_continues_keeps_what_was_decided_however_fast_the_machine_is_now() {
        let dir = tempfile::tempdir().expect("a folder");
        let cache = Cache::open(dir.path().join("cache")).expect("a cache");
        let choice = Key::of("choice").value("scene", 1).finish();
        let settings = with_time(600);
        assert_eq!(time_before(&cache, &settings, &choice).expect("readable"), None);
        let (key, first) =
            decided_once(&cache, &settings, &choice, || Ok(on_machine(&settings, 0.2))).expect("decided");
        let again = || -> Result<TimeChoice, RunError> { panic!("it is decided once") };
        let (same, second) = decided_once(&cache, &settings, &choice, again).expect("kept");
        assert_eq!((key, first.steps, &first.why), (same, second.steps, &second.why));
        let trained = |choice: &TimeChoice| choice.decided(&settings, true).train;
        assert_eq!(trained(&first), trained(&second));
        assert_eq!(trained(&first).steps, first.steps);
        assert!((100..10_000).contains(&first.steps), "{}", first.steps);
        // A record on disk says the same to another process.
        let elsewhere = Cache::at(dir.path().join("cache"));
        let kept = time_before(&elsewhere, &settings, &choice).expect("readable").expect("kept");
        assert_eq!(kept.steps, first.steps);
        // Another time, or another scene, is decided by itself.
        let longer = with_time(1200);
        let (_, more) =
            decided_once(&cache, &longer, &choice, || Ok(on_machine(&longer, 0.2))).expect("decided");
        assert!(more.steps > first.steps);
        let other = Key::of("choice").value("scene", 2).finish();
        assert_eq!(time_before(&cache, &settings, &other).expect("readable"), None);
        assert_eq!(time_before(&cache, &with_time(0), &choice).expect("readable"), None, "no time is given");
    }

    #[test]
    fn fewer_splats_are_set_and_all_are_left_to_the_scene() {
        let settings = with_time(600);
        let mut bought = on_machine(&settings, 0.01);
        assert_eq!((bought.splats, bought.decided(&settings, true).train.splats), (0, 0));
        bought.splats = 5000;
        assert_eq!(bought.decided(&settings, true).train.splats, 5000);
    }

    #[test]
    fn a_time_that_something_else_decides_is_refused_in_words() {
        let refused = |change: &dyn Fn(&mut Settings)| {
            let mut settings = with_time(600);
            change(&mut settings);
            fits_time(&scene(), &settings, None).expect_err("refused").to_string()
        };
        let both = refused(&|settings| (settings.train.steps, settings.train.splats) = (500, 9000));
        assert!(both.contains("--time 10m") && both.contains("--splats 9000 are both set"), "{both}");
        let effort = refused(&|settings| settings.train.effort = 2.0);
        assert!(effort.contains("--effort 2 both decide the steps"), "{effort}");
        let blocks = refused(&|settings| settings.train.blocks = 3);
        assert!(blocks.contains("3 blocks") && blocks.contains("--steps"), "{blocks}");
        // One of the two is set, another preset with its own effort, or no time at all.
        let fits = |settings: &Settings| fits_time(&scene(), settings, None).is_ok();
        let mut settings = with_time(600);
        settings.train = TrainSettings { steps: 500, ..settings.train };
        assert!(fits(&settings));
        for preset in [Preset::Draft, Preset::Best] {
            let mut settings = Settings::preset(preset);
            settings.run.time = WallTime::of(600);
            assert!(fits(&settings), "{preset}");
        }
        let mut settings = with_time(0);
        (settings.train.steps, settings.train.splats) = (500, 9000);
        assert!(fits(&settings));
    }

    #[test]
    fn an_image_is_turned_and_back() {
        let image = Image { width: 2, height: 1, channels: 2, data: vec![0.1, 0.2, 0.3, 0.4] };
        assert_eq!(turned(&image).data, [0.2, 0.1, 0.4, 0.3]);
        assert_eq!(turned(&turned(&image)), image);
    }
}
