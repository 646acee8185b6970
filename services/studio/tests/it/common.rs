//! A small scene that is trained once for all tests of the program, whether they run in one process or in many.

#[path = "../../../../tests/support/made_once.rs"]
mod made_once;

use made_once::made_once;
use segwild_eval::oracle::OracleOptions;
use segwild_eval::trial::{ProviderKind, Trial};
use segwild_flow::Stopper;
use segwild_pipeline::{Preset, RunFolder, Settings};
use segwild_studio::messages::{ShownPrompts, StateMessage, StudioAction};
use segwild_studio::{Studio, StudioError};
use segwild_synthetic::{ObjectKind, SyntheticOptions};
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

/// How long an answer may take before a test fails.
const LONGEST: Duration = Duration::from_secs(120);

/// The file with the clicks, beside the run.
const CLICKS: &str = "clicks.json";

/// A trained run, and a click on each of its objects: the photo's name and the pixel.
pub struct Trained {
    folder: PathBuf,
    pub clicks: Vec<(String, [f32; 2])>,
}

/// The trained run.
pub fn trained() -> &'static Trained {
    static TRAINED: OnceLock<Trained> = OnceLock::new();
    TRAINED.get_or_init(|| {
        let made = made_once("studio", &[], train);
        let clicks = std::fs::read(made.join(CLICKS)).unwrap();
        Trained { folder: made.join("run"), clicks: serde_json::from_slice(&clicks).unwrap() }
    })
}

/// Trains it in a folder, with a click per object beside it.
fn train(dir: &Path) {
    let scene = SyntheticOptions {
        seed: 5,
        train: 12,
        test: 2,
        long_side: 128,
        points: 1000,
        occlusion: 0.0,
        ..SyntheticOptions::default()
    };
    let trial = Trial::new(dir, &scene, ProviderKind::Builtin, &OracleOptions::default()).unwrap();
    let mut settings = Settings::preset(Preset::Draft);
    settings.train.steps = 250;
    settings.masks.prompt_budget = 16;
    trial.train(&settings).unwrap();
    let objects = trial.manifest().objects.iter().filter(|o| o.kind == ObjectKind::Object);
    let of_object = |c: &segwild_synthetic::Click| (c.photo.clone(), [c.x, c.y]);
    let clicks: Vec<(String, [f32; 2])> = objects.filter_map(|o| o.clicks.first()).map(of_object).collect();
    assert_eq!(trial.folder().path(), dir.join("run"));
    std::fs::write(dir.join(CLICKS), serde_json::to_string(&clicks).unwrap()).unwrap();
}

/// A copy of the trained run, to work on.
pub fn run() -> (tempfile::TempDir, RunFolder) {
    let dir = tempfile::tempdir().unwrap();
    copy(&trained().folder, dir.path());
    let folder = RunFolder::open(dir.path()).unwrap();
    (dir, folder)
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().flatten() {
        let target = to.join(entry.file_name());
        match entry.file_type().unwrap().is_dir() {
            true => copy(&entry.path(), &target),
            false => drop(std::fs::copy(entry.path(), target).unwrap()),
        }
    }
}

/// Opens a run's session.
pub fn open(folder: &RunFolder) -> Arc<Studio> {
    Studio::open(folder, "trial", &Stopper::new()).unwrap()
}

/// Waits for a state.
pub fn until(studio: &Studio, wanted: impl Fn(&StateMessage) -> bool) -> StateMessage {
    let began = Instant::now();
    loop {
        let message = studio.message();
        if wanted(&message) {
            return message;
        }
        assert!(began.elapsed() < LONGEST, "it never came: {message:?}");
        std::thread::park_timeout(Duration::from_millis(5));
    }
}

/// Waits for the last answer.
pub fn answered(studio: &Studio) -> StateMessage {
    until(studio, |message| matches!(message.answer.state, "done" | "failed"))
}

/// The click on an object.
pub fn click(studio: &Studio, object: usize) -> StudioAction {
    let (photo, [x, y]) = &trained().clicks[object];
    let photo = studio.session().scene().view_named(photo).unwrap();
    let prompts = segwild_scene::Prompts::click(*x, *y);
    StudioAction::Prompt { prompts: vec![ShownPrompts { photo, prompts }], alternative: 0 }
}

/// Clicks an object and keeps the answer.
pub fn keep(studio: &Arc<Studio>, object: usize, name: &str) -> Result<(), StudioError> {
    studio.act(click(studio, object))?;
    answered(studio);
    studio.act(StudioAction::Keep { name: Some(name.into()) })
}
