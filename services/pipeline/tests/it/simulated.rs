//! A small scene, and actors that compute nothing: their answers come in an order that a seed decides.

use segwild_features::{FeatureDecoder, FeatureField, FeatureOutcome, FeatureTask, Pca};
use segwild_flow::{Actor, ActorFailure, ActorOptions, Cache, Context, Message, Quarantined, Sender, System};
use segwild_masks::{MaskOutcome, MaskTask};
use segwild_objective::background::Background;
use segwild_objective::{AnyAppearance, NoAppearance};
use segwild_pipeline::{ActorInboxes, ActorOutcome, ActorParts, RunError, Settings, Stage, Wiring};
use segwild_scene::{HoldOut, Image, Mask, Scene, Splats};
use segwild_trainer::{AppearanceModel, Model, Stats, TrainOrder, TrainOutcome};
use std::collections::VecDeque;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Photos of the scene; none is held out.
pub const PHOTOS: usize = 5;
/// Splats of the simulated training.
pub const SPLATS: usize = 4;

/// Something that happened, in the order in which it did.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Seen {
    /// The actor of a stage received an order; of a photo, where the stage goes photo by photo.
    Ordered(Stage, Option<usize>),
    /// It is about to answer.
    Answered(Stage, Option<usize>),
    /// The trainer is about to send its snapshot.
    Snapshot,
}

/// Simulated actors.
#[derive(Default)]
pub struct Simulated {
    /// Decides the order of the answers.
    pub seed: u64,
    /// Photos that a stage gives up.
    pub gives_up: Vec<(Stage, usize)>,
    /// Holds the end of the training back until masks are ordered.
    pub trains_until_masks: bool,
    /// What happened.
    pub seen: Arc<Mutex<Vec<Seen>>>,
    /// The photos that the field is made of.
    pub field_of: Arc<Mutex<Vec<usize>>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Simulated {
    /// Everything that happened so far.
    pub fn log(&self) -> Vec<Seen> {
        lock(&self.seen).clone()
    }
}

/// Answers that were not sent yet. Those of one queue keep their order.
type Pool = Arc<Mutex<Vec<VecDeque<(Seen, ActorOutcome)>>>>;

/// What an actor of the simulation does with a message: it adds answers to the pool.
struct SimulatedActor<M, F> {
    handle: F,
    message: std::marker::PhantomData<fn(M)>,
}

impl<M: Message, F: FnMut(M) -> Result<(), ActorFailure> + Send + 'static> Actor for SimulatedActor<M, F> {
    type Message = M;

    fn handle(&mut self, message: M, _: &Context) -> Result<(), ActorFailure> {
        (self.handle)(message)
    }
}

fn actor<M: Message, F: FnMut(M) -> Result<(), ActorFailure> + Send + 'static>(
    handle: F,
) -> SimulatedActor<M, F> {
    SimulatedActor { handle, message: std::marker::PhantomData }
}

/// What every simulated actor has.
#[derive(Clone)]
struct Desk {
    pool: Pool,
    seen: Arc<Mutex<Vec<Seen>>>,
    gives_up: Arc<Vec<(Stage, usize)>>,
    cache: Cache,
    scene: Arc<Scene>,
}

impl Desk {
    fn ordered(&self, stage: Stage, view: Option<usize>) {
        lock(&self.seen).push(Seen::Ordered(stage, view));
    }

    fn answers(&self, answers: impl IntoIterator<Item = (Seen, ActorOutcome)>) {
        lock(&self.pool).push(answers.into_iter().collect());
    }

    /// Answers for one photo.
    fn answer(&self, stage: Stage, view: usize, outcome: ActorOutcome) {
        self.answers([(Seen::Answered(stage, Some(view)), outcome)]);
    }

    fn given_up(&self, stage: Stage, view: usize) -> Result<(), Quarantined> {
        let label = self.scene.views[view].name.clone();
        match self.gives_up.contains(&(stage, view)) {
            true => Err(Quarantined { label, error: "simulated".into(), attempts: 3 }),
            false => Ok(()),
        }
    }

    fn masks(&self, task: MaskTask) -> Result<(), ActorFailure> {
        match task {
            MaskTask::Sky { view, key } => {
                self.ordered(Stage::Sky, Some(view));
                let sky = Arc::new(Mask::empty(32, 24));
                let found = self.given_up(Stage::Sky, view);
                if found.is_ok() {
                    self.cache.put_typed(&key, "sky", &*sky)?;
                }
                let outcome = MaskOutcome::Sky { view, sky: found.map(|()| sky), seconds: Some(0.0) };
                self.answer(Stage::Sky, view, outcome.into());
            }
            MaskTask::Masks { view, .. } => {
                self.ordered(Stage::Masks, Some(view));
                let masks = self.given_up(Stage::Masks, view).map(|()| 0);
                let outcome = MaskOutcome::Masks { view, masks, seconds: Some(0.0) };
                self.answer(Stage::Masks, view, outcome.into());
            }
        }
        Ok(())
    }

    fn features(&self, task: FeatureTask, field_of: &Mutex<Vec<usize>>) {
        match task {
            FeatureTask::Embed { view, .. } => {
                self.ordered(Stage::Embed, Some(view));
                let outcome = match self.given_up(Stage::Embed, view) {
                    Ok(()) => FeatureOutcome::Embedded { view, seconds: Some(0.0) },
                    Err(given_up) => FeatureOutcome::EmbedFailed { view, given_up },
                };
                self.answer(Stage::Embed, view, outcome.into());
            }
            FeatureTask::Field { splats, views, .. } => {
                self.ordered(Stage::Features, None);
                views.as_ref().clone_into(&mut lock(field_of));
                let field = FeatureOutcome::Field(Box::new(field(splats.len())));
                self.answers([(Seen::Answered(Stage::Features, None), field.into())]);
            }
        }
    }

    fn trainer(&self, order: &TrainOrder) {
        self.ordered(Stage::Geometry, None);
        let upcoming = (0..self.scene.views.len()).collect();
        let began = TrainOutcome::Began { step: 0, upcoming };
        let mut answers = vec![(Seen::Ordered(Stage::Geometry, None), began.into())];
        if order.until < order.settings.steps {
            answers.push((Seen::Answered(Stage::Geometry, None), TrainOutcome::Paused(order.until).into()));
        } else {
            let model = Arc::new(model(&self.scene));
            answers.push((Seen::Snapshot, TrainOutcome::Snapshot(model.clone()).into()));
            let done = TrainOutcome::Done(model, Vec::new());
            answers.push((Seen::Answered(Stage::Geometry, None), done.into()));
        }
        self.answers(answers);
    }
}

impl Wiring for Simulated {
    fn spawn(&self, system: &System, inboxes: ActorInboxes, parts: ActorParts) -> Result<(), RunError> {
        let ActorInboxes { masks, features, training, out } = inboxes;
        let pool = Pool::default();
        let desk = Desk {
            pool: pool.clone(),
            seen: self.seen.clone(),
            gives_up: Arc::new(self.gives_up.clone()),
            cache: parts.cache.clone(),
            scene: parts.photos.scene().clone(),
        };
        let (one, field_of) = (desk.clone(), self.field_of.clone());
        system.spawn(features, ActorOptions::default(), move || {
            let (desk, field_of) = (one.clone(), field_of.clone());
            Ok(actor(move |task| {
                desk.features(task, &field_of);
                Ok(())
            }))
        })?;
        let one = desk.clone();
        system.spawn(training, ActorOptions::default(), move || {
            let desk = one.clone();
            Ok(actor(move |order: TrainOrder| {
                desk.trainer(&order);
                Ok(())
            }))
        })?;
        system.spawn(masks, ActorOptions::default(), move || {
            let desk = desk.clone();
            Ok(actor(move |task| desk.masks(task)))
        })?;
        let sender = Answering {
            pool,
            seen: self.seen.clone(),
            random: self.seed,
            holds_training: self.trains_until_masks,
        };
        sender.start(system, out)
    }
}

/// Sends the answers of the pool in an order of its own.
struct Answering {
    pool: Pool,
    seen: Arc<Mutex<Vec<Seen>>>,
    random: u64,
    holds_training: bool,
}

impl Answering {
    fn start(mut self, system: &System, out: Sender<ActorOutcome>) -> Result<(), RunError> {
        let began = Instant::now();
        system.source("answers", ActorOptions::default(), move |context| {
            loop {
                context.check()?;
                if self.next().is_multiple_of(3) {
                    context.sleep(Duration::from_micros(self.next() % 1500));
                }
                match self.take(began) {
                    Some((seen, outcome)) => {
                        lock(&self.seen).push(seen);
                        out.blocking_send(outcome)?;
                    }
                    // The actors have ended: nothing more will come.
                    None if Arc::strong_count(&self.pool) == 1 => return Ok(()),
                    None => {
                        context.sleep(Duration::from_micros(200));
                    }
                }
                context.progress();
            }
        })?;
        Ok(())
    }

    /// The next random number (splitmix64).
    fn next(&mut self) -> u64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// The first answer of one of the queues.
    fn take(&mut self, began: Instant) -> Option<(Seen, ActorOutcome)> {
        let at = self.next() as usize;
        let masks = |seen: &Seen| matches!(seen, Seen::Ordered(Stage::Masks, _));
        let waits =
            self.holds_training && !lock(&self.seen).iter().any(masks) && began.elapsed().as_secs() < 20;
        let mut pool = lock(&self.pool);
        pool.retain(|queue| !queue.is_empty());
        let trained = Seen::Answered(Stage::Geometry, None);
        let may = |queue: &VecDeque<(Seen, ActorOutcome)>| !(waits && queue[0].0 == trained);
        let open: Vec<usize> = (0..pool.len()).filter(|&i| may(&pool[i])).collect();
        let chosen = *open.get(at.checked_rem(open.len())?)?;
        pool[chosen].pop_front()
    }
}

/// A scene of a few splats before the cameras.
fn model(scene: &Scene) -> Model {
    let views = scene.views.len();
    let background = Background { coefficients: vec![[0.5; 3]] };
    Model {
        splats: Arc::new(Splats {
            means: (0..SPLATS).map(|i| [0.1 * i as f32, 0.0, 1.0]).collect(),
            log_scales: vec![[-2.0; 3]; SPLATS],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; SPLATS],
            opacities: vec![2.0; SPLATS],
            sh_degree: 0,
            sh: vec![0.3; 3 * SPLATS],
        }),
        splat_embeddings: Vec::new(),
        appearance: AnyAppearance::None(NoAppearance),
        backgrounds: vec![Some(background); views],
        names: scene.views.iter().map(|view| view.name.clone()).collect(),
        trained_on: (0..views as u32).collect(),
        transient_shares: vec![0.0; views],
        transient_evidence: vec![None; views],
        refined_poses: vec![None; views],
        antialias: true,
        stats: Stats { step: 30, psnr: Some(20.0) },
    }
}

/// A field of one channel.
fn field(splats: usize) -> FeatureField {
    let pca = Pca {
        embedding_channels: 1,
        channels: 1,
        mean: vec![0.0],
        basis: vec![1.0],
        scale: 1.0,
        variances: vec![1.0],
        total_variance: 1.0,
    };
    let decoder = FeatureDecoder { channels: 1, embedding_channels: 1, weights: vec![1.0], bias: vec![0.0] };
    FeatureField::rounded(1, &vec![0.5; splats], pca, decoder).expect("numbers that fit")
}

/// Writes a scene of [`PHOTOS`] photos, side by side.
pub fn write_scene(folder: &Path) {
    write_scene_of(folder, PHOTOS);
}

/// Writes a scene of so many photos, side by side.
pub fn write_scene_of(folder: &Path, photos: usize) {
    std::fs::create_dir_all(folder.join("images")).expect("a folder");
    let mut frames = Vec::new();
    for i in 0..photos {
        let mut image = Image::zeros(40, 30, 3);
        for (k, value) in image.data.iter_mut().enumerate() {
            *value = ((k * (i + 3)) % 97) as f32 / 97.0;
        }
        image.write_png(&folder.join(format!("images/{i}.png"))).expect("a photo");
        frames.push(format!(
            r#"{{"file_path": "images/{i}.png", "transform_matrix": [[1,0,0,{}],[0,-1,0,0],[0,0,-1,0],[0,0,0,1]]}}"#,
            0.25 * i as f32
        ));
    }
    let points: Vec<String> = (0..8).map(|i| format!("{} {} 5 90 120 150", i % 4, i / 4)).collect();
    let head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n\
                property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    std::fs::write(folder.join("points.ply"), format!("{head}{}\n", points.join("\n"))).expect("points");
    let cameras = r#""fl_x": 50, "fl_y": 50.0, "cx": 20, "cy": 15, "w": 40, "h": 30"#;
    let text =
        format!("{{\"ply_file_path\": \"points.ply\", {cameras}, \"frames\": [{}]}}", frames.join(",\n"));
    std::fs::write(folder.join("transforms.json"), text).expect("cameras");
}

/// Settings under which nothing is chosen and nothing takes long.
pub fn settings() -> Settings {
    let mut settings = Settings::default();
    settings.scene.size = 32;
    settings.scene.hold_out = HoldOut::None;
    settings.train.steps = 30;
    settings.train.appearance_model = AppearanceModel::None;
    settings
}
