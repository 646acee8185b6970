//! The settings of the run as a whole; those of its stages stand in their crates.

use segwild_scene::{WallTime, choice, settings};
use segwild_trainer::Preset;

choice! {
    /// The engine that renders and trains the splats.
    pub enum EngineKind {
        /// A hardware GPU if there is one, never software Vulkan; else the CPU.
        Auto = "auto",
        /// The CPU engine.
        Cpu = "cpu",
        /// A hardware GPU, or what `adapter` names; an error without it.
        Gpu = "gpu",
    }
}

choice! {
    /// What happens when the accelerator fails while it computes.
    pub enum WhenLost {
        /// The run stops, and the same command continues it, under `--engine cpu` too.
        Stop = "stop",
        /// The CPU engine takes over.
        Cpu = "cpu",
    }
}

choice! {
    /// What decides the steps, channels and appearance model of a run.
    pub enum RunBudget {
        /// The settings, as they are.
        Fixed = "fixed",
        /// The scene: the least steps, channels and appearance model that suffice, found by short trainings that are
        /// scored on photos held out of them. `steps` is the most that is spent; where it is left to the scene and
        /// photos agree, eight times the scene's own.
        Auto = "auto",
    }
}

choice! {
    /// How held-out photos are scored.
    pub enum Scoring {
        /// `plain` under the appearance model `none`, else `halves`.
        Auto = "auto",
        /// The whole photo, with no appearance fitted to it.
        Plain = "plain",
        /// The appearance fitted on the left half, the right half scored: the official protocol of unconstrained photos.
        Halves = "halves",
    }
}

choice! {
    /// The photos that masks and descriptors are made of.
    pub enum DescribedPhotos {
        /// All of up to 200. Of more, the 200 that show most of the scene from most directions, and the others as far as they show
        /// what few of these do.
        Auto = "auto",
        /// All that are trained on.
        All = "all",
    }
}

settings! {
    /// The run as a whole.
    pub struct RunSettings("run", user: preset budget time engine threads) {
        /// How much time to spend. It sets the defaults of the other settings.
        preset: Preset = Preset::Standard,
        /// Who decides steps, channels, appearance. What a flag or file sets stays as set.
        budget: RunBudget = RunBudget::Fixed,
        /// Time that the whole run may take; it decides steps and splats. As 90s, 10m or 1h30m; 0: they do not depend on it. The
        /// machine is measured first, and the run says what the time buys. What is decided is kept with the run.
        time: WallTime = WallTime::default(),
        /// Compute threads; 0 takes all cores. The result does not depend on it.
        threads: u32 = 0 => 0..=256,
        /// What computes the splats.
        engine: EngineKind = EngineKind::Cpu,
        /// Part of the accelerator's name, where there are several; empty takes the best. `segwild doctor` lists them.
        adapter: String = String::new(),
        /// What happens when the accelerator fails during the run.
        when_lost: WhenLost = WhenLost::Stop,
        /// How held-out photos are scored.
        scoring: Scoring = Scoring::Auto,
        /// Weights of LPIPS, the perceptual distance, as `.safetensors` (docs/guide/research.md). Held-out photos are scored by it
        /// too, and the loss may have it (`lambda_lpips`). Empty: none.
        lpips_weights: String = String::new(),
        /// Seconds between checkpoints of the training; an interrupted run loses no more than this.
        checkpoint_every: u32 = 30 => 1..,
        /// Most MiB of memory that the run may take; 0 sets no limit. The same holds for an accelerator's own memory.
        /// Caches shrink to fit; what cannot fit is refused before the start.
        memory_budget: u32 = 0,
        /// Photos that masks and descriptors are made of at the same time, beside the training. 0: half of the cores, and as many
        /// as vision services take.
        photos_at_once: u32 = 0 => 0..=64,
        /// Photos that masks and descriptors are made of. All are trained on, whatever this says, and all have transient masks.
        described_photos: DescribedPhotos = DescribedPhotos::Auto,
        /// Memory in MiB for photos that were decoded, until the next stage reads them.
        photo_memory: u32 = 64,
        /// Checkpoints of the training that are kept; with 2, a damaged one has another to fall back on.
        keep_checkpoints: u32 = 2 => 1..,
        /// Most MiB that the cache keeps when a run ends, oldest first out; 0 keeps all. What this run uses always stays.
        cache_limit: u64 = 0,
        /// Seconds without a sign of life after which a worker is named as stuck.
        stuck_after: u32 = 60 => 1..,
        /// Continue a finished training after transient masks were corrected by hand, for this share of the steps. 0
        /// trains from the start.
        continue_share: f32 = 0.0 => 0.0..=10.0,
        /// Photo pairs shown in the report.
        report_photos: u32 = 8,
    }
}
