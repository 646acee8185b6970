//! Where a run computes, and who holds the accelerator: seen by providers from inside a real run.
//!
//! The accelerator and its counts belong to the whole process: no other test of this program may hold it.

use rayon::prelude::*;
use segwild_pipeline::{RunFolder, RunOptions, Settings, accelerator, run};
use segwild_scene::{Embedding, Image, Mask, ScoredMask};
use segwild_synthetic::{LightVariation, SyntheticOptions, generate};
use segwild_vision::{Embedder, MaskProposer, Providers, SkyDetector, VisionError};
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

/// Providers that declare an accelerator and note which threads their kernels run on and how many are inside at once.
#[derive(Default)]
struct Watchers {
    inside: AtomicUsize,
    most: AtomicUsize,
    calls: AtomicUsize,
    threads: Mutex<BTreeSet<(&'static str, String)>>,
}

impl Watchers {
    fn kernel(&self, what: &'static str) {
        let inside = self.inside.fetch_add(1, Ordering::SeqCst) + 1;
        self.most.fetch_max(inside, Ordering::SeqCst);
        self.calls.fetch_add(1, Ordering::SeqCst);
        (0..500).into_par_iter().for_each(|_| {
            let name = std::thread::current().name().unwrap_or("unnamed").to_owned();
            self.threads.lock().unwrap().insert((what, name));
        });
        self.inside.fetch_sub(1, Ordering::SeqCst);
    }
}

impl Embedder for Watchers {
    fn key(&self) -> String {
        "watcher".into()
    }
    fn accelerator(&self) -> bool {
        true
    }
    fn embed(&self, image: &Image) -> Result<Embedding, VisionError> {
        self.kernel("embed");
        let small = image.resized(8, 6);
        Ok(Embedding { width: 8, height: 6, channels: 3, data: small.data })
    }
}

impl MaskProposer for Watchers {
    fn key(&self) -> String {
        "watcher".into()
    }
    fn accelerator(&self) -> bool {
        true
    }
    fn propose(&self, image: &Image, _: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        self.kernel("masks");
        let half = Mask::from_fn(image.width as u32, image.height as u32, |x, _| 2 * x < image.width as u32);
        Ok(vec![ScoredMask { mask: half, predicted_iou: 0.95, stability: 0.98 }])
    }
}

impl SkyDetector for Watchers {
    fn key(&self) -> String {
        "watcher".into()
    }
    fn accelerator(&self) -> bool {
        true
    }
    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        self.kernel("sky");
        Ok(Mask::empty(image.width as u32, image.height as u32))
    }
}

#[test]
fn kernels_of_a_run_stay_on_their_actors_threads_and_one_at_a_time_holds_the_accelerator() {
    let dir = tempfile::tempdir().unwrap();
    let scene = dir.path().join("scene");
    let options = SyntheticOptions {
        train: 6,
        test: 1,
        long_side: 64,
        points: 300,
        occlusion: 0.0,
        photo_light: LightVariation::Affine,
        ..SyntheticOptions::small()
    };
    generate(&options).unwrap().write(&scene).unwrap();
    // A choice of `auto` is made before there are actors.
    let flags = [
        ("preset", "draft"),
        ("size", "64"),
        ("steps", "40"),
        ("appearance_model", "affine"),
        ("refine_steps", "4"),
        ("threads", "2"),
    ];
    let flags: Vec<(String, String)> = flags.iter().map(|(n, v)| ((*n).into(), (*v).into())).collect();
    let settings = Settings::layered(None, &flags).unwrap();
    let watchers = Arc::new(Watchers::default());
    let builtin = Providers::from_settings(&settings.vision).unwrap();
    let providers = Providers {
        embedder: watchers.clone(),
        proposer: watchers.clone(),
        sky: watchers.clone(),
        ..builtin
    };
    let folder = RunFolder::create(&dir.path().join("run")).unwrap();
    let before = accelerator().stats();
    run(&scene, &folder, &settings, &RunOptions { providers: Some(providers), ..RunOptions::default() })
        .unwrap();

    let calls = watchers.calls.load(Ordering::SeqCst);
    assert!(calls >= 7 + 6 + 6, "{calls} calls");
    assert_eq!(watchers.most.load(Ordering::SeqCst), 1, "two computed on the accelerator at once");
    let after = accelerator().stats();
    assert_eq!((after.taken - before.taken, after.holder, after.waiting), (calls as u64, None, 0));
    let threads = watchers.threads.lock().unwrap();
    for (what, actor) in [("sky", "masks/"), ("masks", "masks/"), ("embed", "features/")] {
        let names: Vec<&String> = threads.iter().filter(|(w, _)| *w == what).map(|(_, name)| name).collect();
        assert!((1..=2).contains(&names.len()), "{what}: {names:?}");
        assert!(names.iter().all(|name| name.starts_with(actor)), "{what} computed on {names:?}");
    }
}
