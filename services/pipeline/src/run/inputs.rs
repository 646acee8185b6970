//! The inputs of the feature field, as its actor reads them: from the cache, or computed again where the cache is
//! damaged.

use crate::RunFolder;
use crate::artifacts::folder::MODEL;
use crate::artifacts::keys::Keys;
use crate::artifacts::photo_boundaries::MASKS;
use crate::artifacts::recompute::{CachedArtefact, Recompute};
use crate::run::skies::Skies;
use crate::run::view_slots::ViewSlots;
use crate::transients::{KnownTransients, TransientMaskWriter, visibility};

use segwild_features::{EMBEDDING, FieldInputs, describe};
use segwild_flow::{ActorFailure, Context};
use segwild_masks::{MaskMaker, MaskSource, Snapshot};
use segwild_objective::Engine;
use segwild_scene::{Embedding, Image, Mask, MaskSet, PhotoStore, Pose, ReaderError, Scene};
use segwild_trainer::{Model, TrainPhoto, render_view};
use segwild_vision::{Embedder, PromptSegmenter};
use std::sync::Arc;

/// Kind of the cache's visibility records.
pub const VISIBILITY: &str = "visibility";

/// Renders the scene of the snapshot step, from which masks are proposed.
pub struct SnapshotRenders {
    /// The scene at the snapshot step.
    pub model: Arc<Model>,
    /// Renders it.
    pub engine: Arc<dyn Engine>,
    /// The cameras, as it was trained.
    pub scene: Arc<Scene>,
    /// Long side of the renders in pixels.
    pub size: u32,
}

impl SnapshotRenders {
    /// Renders a snapshot of a scene, given with its poses before the training, at a long side of so many pixels.
    pub fn new(model: Arc<Model>, engine: Arc<dyn Engine>, scene: &Arc<Scene>, size: u32) -> SnapshotRenders {
        let scene = model.posed(scene);
        SnapshotRenders { model, engine, scene, size }
    }
}

impl Snapshot for SnapshotRenders {
    fn means(&self) -> &[[f32; 3]] {
        &self.model.splats.means
    }

    fn pose(&self, view: usize) -> Pose {
        self.scene.views[view].pose
    }

    fn render(&self, view: usize) -> Result<Image, ReaderError> {
        let posed = &self.scene.views[view];
        let camera = posed.camera.scaled_to(self.size);
        Ok(render_view(&self.model, &*self.engine, &camera, &posed.pose, None)?)
    }
}

/// The inputs of one run's field.
pub struct Inputs {
    /// The scene with its poses as given.
    pub given: Arc<Scene>,
    /// Reads artefacts from the cache.
    pub recompute: Recompute,
    /// Their keys.
    pub keys: Keys,
    /// The photos.
    pub photos: Arc<PhotoStore>,
    /// The trained scene.
    pub model: Arc<Model>,
    /// Renders it.
    pub engine: Arc<dyn Engine>,
    /// The skies.
    pub skies: Arc<Skies>,
    /// Which views have masks.
    pub masks_known: Arc<ViewSlots<bool>>,
    /// Computes the embeddings of photos.
    pub embedder: Arc<dyn Embedder>,
    /// Proposes masks.
    pub maker: Arc<MaskMaker>,
    /// The transients that are known before the training.
    pub known: KnownTransients,
    /// Photos that are worked on at once, for the mask images of transients.
    pub photos_at_once: usize,
}

impl Inputs {
    /// Compares a photo with the trained scene: its visibility.
    pub fn compare(&self, view: usize) -> Result<Mask, ActorFailure> {
        let sky = self.skies.read(view)?;
        let transients = &self.known.corrections;
        Ok(visibility(&self.model, &*self.engine, &self.photos, view, sky.as_ref(), transients)?)
    }

    /// Writes the mask image of each photo's transients into the run folder. Returns warnings about single photos.
    pub fn write_transient_masks(
        &self,
        folder: &RunFolder,
        views: &[usize],
        segmenter: &dyn PromptSegmenter,
        context: &Context,
    ) -> Result<Vec<String>, ActorFailure> {
        let writer = TransientMaskWriter {
            folder,
            scene: &self.recompute.scene,
            model: &self.model,
            engine: &*self.engine,
            segmenter,
            known: &self.known,
            at_once: self.photos_at_once,
        };
        let photo = |view: usize| -> Result<TrainPhoto, ActorFailure> {
            let loaded = self.photos.read(view).map_err(ActorFailure::retry)?;
            let mut photo = TrainPhoto::new(Arc::unwrap_or_clone(loaded), self.skies.read(view)?);
            self.known.apply(view, &mut photo).map_err(ActorFailure::retry)?;
            Ok(photo)
        };
        writer.write(
            views,
            |view| self.keys.transients(view, &segmenter.key()),
            photo,
            |_| {
                context.progress();
                context.check()
            },
        )
    }

    fn make_masks(&self, view: usize) -> Result<MaskSet, ActorFailure> {
        let model = self.recompute.cache.get_typed::<Model>(&self.keys.snapshot, MODEL)?;
        let model = model.filter(|model| model.check().is_ok());
        let gone = || ActorFailure::retry("the snapshot that they were proposed from has gone, too");
        let (model, scene) = (Arc::new(model.ok_or_else(gone)?), &self.given);
        let snapshot = SnapshotRenders::new(model, self.engine.clone(), scene, self.photos.long_side());
        let sky = self.skies.read(view)?;
        let render = match self.maker.settings.mask_source {
            MaskSource::Render => Some(snapshot.render(view).map_err(ActorFailure::retry)?),
            MaskSource::Photo => None,
        };
        Ok(self.maker.make(view, render.as_ref(), &snapshot, sky.as_ref())?)
    }
}

impl FieldInputs for Inputs {
    fn scene(&self) -> &Scene {
        &self.recompute.scene
    }

    fn embedding(&self, view: usize) -> Result<Embedding, ActorFailure> {
        let kept =
            CachedArtefact { view, what: "embedding", kind: EMBEDDING, key: &self.keys.embedding[view] };
        self.recompute
            .read(kept, || describe(&*self.embedder, &self.photos, view).map_err(ActorFailure::retry))
    }

    fn visibility(&self, view: usize) -> Result<Mask, ActorFailure> {
        let kept =
            CachedArtefact { view, what: "visibility", kind: VISIBILITY, key: &self.keys.visibility[view] };
        self.recompute.read(kept, || self.compare(view))
    }

    fn sky(&self, view: usize) -> Result<Option<Mask>, ActorFailure> {
        self.skies.read(view)
    }

    fn masks(&self, view: usize, stopping: &dyn Fn() -> bool) -> Result<Option<MaskSet>, ActorFailure> {
        match self.masks_known.wait(view, stopping) {
            None => Err(ActorFailure::stopped()),
            Some(false) => Ok(None),
            Some(true) => {
                let kept =
                    CachedArtefact { view, what: "set of masks", kind: MASKS, key: &self.keys.masks[view] };
                self.recompute.read(kept, || self.make_masks(view)).map(Some)
            }
        }
    }
}
