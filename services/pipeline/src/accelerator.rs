//! The machine's accelerator, which the providers that compute on it use in turn.

use segwild_flow::Lease;
use segwild_scene::{Embedding, Image, Mask, Prompts, ScoredMask};
use segwild_vision::{
    Embedder, MaskProposer, PromptSegmenter, Prompted, Providers, SkyDetector, VisionError, Work,
};
use std::sync::{Arc, LazyLock};

/// The lease of the one accelerator, for all that this process computes on it. A batch gives it to one process at a time.
pub fn accelerator() -> &'static Lease {
    static LEASE: LazyLock<Lease> = LazyLock::new(|| Lease::new("accelerator"));
    &LEASE
}

/// The same providers; those that declare an accelerator hold the lease while they compute. Clicks and skies come
/// before the others.
pub(crate) fn leased(providers: &Providers) -> Providers {
    let Providers {
        embedder,
        proposer,
        segmenter,
        sky,
        transients,
        texts,
        name,
        notes,
        networks,
        remote_calls,
    } = providers.clone();
    Providers {
        embedder: if embedder.accelerator() { Arc::new(Leased(embedder)) } else { embedder },
        proposer: if proposer.accelerator() { Arc::new(Leased(proposer)) } else { proposer },
        segmenter: if segmenter.accelerator() { Arc::new(Leased(segmenter)) } else { segmenter },
        sky: if sky.accelerator() { Arc::new(Leased(sky)) } else { sky },
        transients,
        texts,
        name,
        notes,
        networks,
        remote_calls,
    }
}

struct Leased<P: ?Sized>(Arc<P>);

impl Embedder for Leased<dyn Embedder> {
    fn key(&self) -> String {
        self.0.key()
    }
    fn embed(&self, image: &Image) -> Result<Embedding, VisionError> {
        let _held = accelerator().acquire("embeddings");
        self.0.embed(image)
    }
}

impl MaskProposer for Leased<dyn MaskProposer> {
    fn key(&self) -> String {
        self.0.key()
    }
    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        let _held = accelerator().acquire("masks");
        self.0.propose(image, points)
    }
    fn work(&self) -> Option<Work> {
        self.0.work()
    }
}

impl SkyDetector for Leased<dyn SkyDetector> {
    fn key(&self) -> String {
        self.0.key()
    }
    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        // The training waits for it, as it does in the actor's mailbox.
        let _held = accelerator().acquire_urgent("sky");
        self.0.sky(image)
    }
}

impl PromptSegmenter for Leased<dyn PromptSegmenter> {
    fn key(&self) -> String {
        self.0.key()
    }
    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError> {
        let _held = accelerator().acquire_urgent("a selection");
        self.0.prompted(image, prompts)
    }
    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        let _held = accelerator().acquire_urgent("a selection");
        self.0.refine(image, certainty)
    }
    fn refined_mask(&self, image: &Image, certainty: &Image) -> Result<(Mask, f32), VisionError> {
        let _held = accelerator().acquire_urgent("a selection");
        self.0.refined_mask(image, certainty)
    }
    fn finds_objects(&self) -> bool {
        self.0.finds_objects()
    }
    fn boundary_strengths(&self, image: &Image) -> Result<Option<Image>, VisionError> {
        let _held = accelerator().acquire("boundaries");
        self.0.boundary_strengths(image)
    }
    fn prepare(&self, image: &Image) {
        let _held = accelerator().acquire("a photo that is likely to be clicked");
        self.0.prepare(image);
    }
    fn is_prepared(&self, image: &Image) -> bool {
        self.0.is_prepared(image)
    }
}
