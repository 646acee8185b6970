//! A count of how often providers are called.

use segwild_scene::{Embedding, Image, Mask, Prompts, ScoredMask};
use segwild_vision::{
    Embedder, MaskProposer, PromptSegmenter, Prompted, Providers, SkyDetector, VisionError, Work,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// How often providers were called.
#[derive(Clone, Debug, Default)]
pub struct Calls(Arc<AtomicUsize>);

impl Calls {
    /// Calls so far.
    pub fn count(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }

    fn one(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

struct CountedProviders(Providers, Calls);

impl Embedder for CountedProviders {
    fn key(&self) -> String {
        self.0.embedder.key()
    }
    fn accelerator(&self) -> bool {
        self.0.embedder.accelerator()
    }
    fn embed(&self, image: &Image) -> Result<Embedding, VisionError> {
        self.1.one();
        self.0.embedder.embed(image)
    }
}

impl MaskProposer for CountedProviders {
    fn key(&self) -> String {
        self.0.proposer.key()
    }
    fn accelerator(&self) -> bool {
        self.0.proposer.accelerator()
    }
    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        self.1.one();
        self.0.proposer.propose(image, points)
    }
    fn work(&self) -> Option<Work> {
        self.0.proposer.work()
    }
}

impl PromptSegmenter for CountedProviders {
    fn key(&self) -> String {
        self.0.segmenter.key()
    }
    fn accelerator(&self) -> bool {
        self.0.segmenter.accelerator()
    }
    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        self.1.one();
        self.0.segmenter.prompted(image, prompts)
    }
    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        self.1.one();
        self.0.segmenter.refine(image, certainty)
    }
    fn refined_mask(&self, image: &Image, certainty: &Image) -> Result<(Mask, f32), VisionError> {
        self.1.one();
        self.0.segmenter.refined_mask(image, certainty)
    }
    fn finds_objects(&self) -> bool {
        self.0.segmenter.finds_objects()
    }
    fn prepare(&self, image: &Image) {
        self.0.segmenter.prepare(image);
    }
    fn is_prepared(&self, image: &Image) -> bool {
        self.0.segmenter.is_prepared(image)
    }
}

impl SkyDetector for CountedProviders {
    fn key(&self) -> String {
        self.0.sky.key()
    }
    fn accelerator(&self) -> bool {
        self.0.sky.accelerator()
    }
    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        self.1.one();
        self.0.sky.sky(image)
    }
}

/// The same providers, their calls counted.
pub fn counted(providers: &Providers) -> (Providers, Calls) {
    let calls = Calls::default();
    let counted = Arc::new(CountedProviders(providers.clone(), calls.clone()));
    let providers = Providers {
        embedder: counted.clone(),
        proposer: counted.clone(),
        segmenter: counted.clone(),
        sky: counted,
        transients: None,
        texts: None,
        name: providers.name.clone(),
        notes: providers.notes.clone(),
        networks: providers.networks.clone(),
        remote_calls: providers.remote_calls,
    };
    (providers, calls)
}
