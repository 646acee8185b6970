//! Providers that cost no core of ours: they wait, as one on another machine or on an accelerator makes us wait.

use segwild_scene::{Embedding, Image, Mask, ScoredMask};
use segwild_vision::{Embedder, MaskProposer, Providers, SkyDetector, VisionError};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How long each answer takes.
#[derive(Clone, Copy, Debug)]
pub struct Waits {
    /// A photo's sky.
    pub sky: Duration,
    /// A photo's embedding.
    pub embed: Duration,
    /// A view's masks.
    pub masks: Duration,
    /// Whether they wait for the one accelerator of this machine, or each for a machine of its own.
    pub accelerator: bool,
}

/// Does nothing for a while.
pub(super) fn wait(time: Duration) {
    let end = Instant::now() + time;
    while let Some(left) = end.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
        std::thread::park_timeout(left);
    }
}

struct WaitingProvider(Waits);

/// Cells along the long side of the embedding, and masks along each side.
const CELLS: usize = 12;
const TILES: u32 = 3;

impl Embedder for WaitingProvider {
    fn key(&self) -> String {
        "waiting embedder 1".into()
    }

    fn accelerator(&self) -> bool {
        self.0.accelerator
    }

    /// The photo's colours, coarse, and their squares.
    fn embed(&self, image: &Image) -> Result<Embedding, VisionError> {
        wait(self.0.embed);
        let height = (CELLS * image.height / image.width.max(1)).max(1);
        let small = image.resized(CELLS, height);
        let squares = small.data.iter().map(|v| v * v - 0.3);
        let data = small.data.iter().copied().chain(squares).collect();
        Ok(Embedding { width: CELLS, height, channels: 6, data })
    }
}

impl MaskProposer for WaitingProvider {
    fn key(&self) -> String {
        "waiting proposer 1".into()
    }

    fn accelerator(&self) -> bool {
        self.0.accelerator
    }

    /// Tiles.
    fn propose(&self, image: &Image, _: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        wait(self.0.masks);
        let (w, h) = (image.width as u32, image.height as u32);
        let tile = |k: u32| {
            let (i, j) = (k % TILES, k / TILES);
            Mask::from_fn(w, h, |x, y| x * TILES / w == i && y * TILES / h == j)
        };
        let scored = |mask| ScoredMask { mask, predicted_iou: 0.95, stability: 0.98 };
        Ok((0..TILES * TILES).map(|k| scored(tile(k))).collect())
    }
}

impl SkyDetector for WaitingProvider {
    fn key(&self) -> String {
        "waiting sky 1".into()
    }

    fn accelerator(&self) -> bool {
        self.0.accelerator
    }

    /// None.
    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        wait(self.0.sky);
        Ok(Mask::empty(image.width as u32, image.height as u32))
    }
}

/// The providers with those for whole photos replaced by ones that wait.
pub fn waiting(providers: &Providers, waits: Waits) -> Providers {
    let waiting = Arc::new(WaitingProvider(waits));
    Providers {
        embedder: waiting.clone(),
        proposer: waiting.clone(),
        sky: waiting,
        name: "waiting".into(),
        notes: vec!["descriptors, masks and sky: a test provider that waits".into()],
        ..providers.clone()
    }
}
