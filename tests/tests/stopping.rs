//! Stops at moments that are hard to hit by a clock.

use segwild_flow::Stopper;
use segwild_pipeline::{RunError, RunFolder, RunOptions, Settings, run};
use segwild_scene::{Image, Mask};
use segwild_synthetic::{SyntheticOptions, generate};
use segwild_vision::{Providers, SkyDetector, VisionError};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Finds the sky of three photos, then asks for a stop, and finds no more until the run has stopped.
struct StopsAfterThree {
    inner: Arc<dyn SkyDetector>,
    found: AtomicUsize,
    stopper: Stopper,
}

impl SkyDetector for StopsAfterThree {
    fn key(&self) -> String {
        self.inner.key()
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        if self.found.fetch_add(1, Ordering::Relaxed) == 3 {
            // The trainer has what it needs for its first steps, and waits for the sky of the next photo.
            let (_never, next) = std::sync::mpsc::channel::<()>();
            let _ = next.recv_timeout(std::time::Duration::from_millis(300));
            self.stopper.stop();
            let _ = next.recv_timeout(std::time::Duration::from_millis(600));
        }
        self.inner.sky(image)
    }
}

#[test]
fn a_run_stopped_while_it_waits_for_a_sky_ends_in_the_same_bytes() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let scene = dir.path().join("scene");
    let options = SyntheticOptions {
        train: 8,
        test: 0,
        long_side: 96,
        points: 400,
        occlusion: 0.0,
        ..SyntheticOptions::small()
    };
    generate(&options).and_then(|s| s.write(&scene)).expect("a synthetic scene");
    let mut settings = Settings::default();
    for (name, value) in [("size", "96"), ("steps", "40"), ("refine_steps", "2"), ("prompt_budget", "16")] {
        settings.set(name, value).expect("a setting");
    }
    let model = |name: &str| std::fs::read(dir.path().join(name).join("model.bin")).expect("a model");
    let folder = |name: &str| RunFolder::create(&dir.path().join(name)).expect("a folder");
    run(&scene, &folder("straight"), &settings, &RunOptions::default()).expect("it runs");

    let stopper = Stopper::new();
    let mut providers = Providers::from_settings(&settings.vision).expect("providers");
    providers.sky = Arc::new(StopsAfterThree {
        inner: providers.sky.clone(),
        found: AtomicUsize::new(0),
        stopper: stopper.clone(),
    });
    let stopped = RunOptions { stopper, providers: Some(providers), ..RunOptions::default() };
    let ended = run(&scene, &folder("stopped"), &settings, &stopped);
    assert!(matches!(ended, Err(RunError::Interrupted)), "{ended:?}");
    run(&scene, &folder("stopped"), &settings, &RunOptions::default()).expect("it goes on");
    assert!(model("stopped") == model("straight"), "a step without the sky of its photo was kept");
}
