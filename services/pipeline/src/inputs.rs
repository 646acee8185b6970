//! What the feature field is made of, as its actor reads it: out of the cache, or made anew where it was damaged there.

use crate::RunFolder;
use crate::artefacts::Keys;
use crate::folder::MODEL;
use crate::recompute::{Kept, Recompute};
use crate::skies::Skies;
use crate::transients::{Album, Known, visibility};
use crate::view_slots::ViewSlots;

use segwild_features::{EMBEDDING, FieldInputs, describe};
use segwild_flow::{Context, Failure};
use segwild_masks::{MaskMaker, MaskSource, Snapshot};
use segwild_raster::Engine;
use segwild_scene::{Embedding, Image, Mask, MaskSet, Scene};
use segwild_trainer::{Model, TrainPhoto, render_view};
use segwild_vision::{Embedder, PromptSegmenter};
use std::sync::Arc;

/// Kind of the cache's records of what can be trusted in a photo.
pub const VISIBILITY: &str = "visibility";
/// Kind of the cache's mask records, as the masks actor writes them.
const MASKS: &str = "masks";

/// The scene at the snapshot step, as the masks are drawn on it.
pub struct Drawn {
    /// The scene.
    pub model: Arc<Model>,
    /// Draws it.
    pub engine: Arc<dyn Engine>,
    /// Its photos.
    pub scene: Arc<Scene>,
    /// Long side of the drawings.
    pub size: u32,
}

impl Snapshot for Drawn {
    fn means(&self) -> &[[f32; 3]] {
        &self.model.splats.means
    }

    fn render(&self, view: usize) -> Result<Image, String> {
        let posed = &self.scene.views[view];
        let camera = posed.camera.scaled_to(self.size);
        render_view(&self.model, &*self.engine, &camera, &posed.pose, None).map_err(|e| e.to_string())
    }
}

/// The inputs of one run's field.
pub struct Inputs {
    /// Reads them.
    pub anew: Recompute,
    /// Their names.
    pub keys: Keys,
    /// Long side at which photos are looked at.
    pub size: u32,
    /// The trained scene.
    pub model: Arc<Model>,
    /// Draws it.
    pub engine: Arc<dyn Engine>,
    /// The skies.
    pub skies: Arc<Skies>,
    /// Which views have masks.
    pub masks_known: Arc<ViewSlots<bool>>,
    /// Describes photos.
    pub embedder: Arc<dyn Embedder>,
    /// Makes masks.
    pub maker: Arc<MaskMaker>,
    /// What is known of transients.
    pub known: Known,
    /// Photos looked at at once, for pictures of transients.
    pub lookers: usize,
}

impl Inputs {
    /// Compares a photo with the trained scene.
    pub fn look(&self, view: usize) -> Result<Mask, Failure> {
        let (posed, sky) = (&self.anew.scene.views[view], self.skies.read(view)?);
        let transients = &self.known.corrections;
        Ok(visibility(&self.model, &*self.engine, posed, view, sky.as_ref(), transients, self.size)?)
    }

    /// Leaves a picture of each photo's transients in the run folder; what is to be said of single photos.
    pub fn picture_transients(
        &self,
        folder: &RunFolder,
        views: &[usize],
        segmenter: &dyn PromptSegmenter,
        context: &Context,
    ) -> Result<Vec<String>, Failure> {
        let album = Album {
            folder,
            scene: &self.anew.scene,
            model: &self.model,
            engine: &*self.engine,
            segmenter,
            known: &self.known,
            at_once: self.lookers,
        };
        let photo = |view: usize| -> Result<TrainPhoto, Failure> {
            let loaded = self.anew.scene.views[view].load(self.size).map_err(Failure::retry)?;
            let mut photo = TrainPhoto::new(loaded, self.skies.read(view)?);
            self.known.tell(view, &mut photo).map_err(Failure::retry)?;
            Ok(photo)
        };
        album.write(
            views,
            |view| self.keys.transients(view, &segmenter.key()),
            photo,
            |_| {
                context.progress();
                context.check()
            },
        )
    }

    fn make_masks(&self, view: usize) -> Result<MaskSet, Failure> {
        let model = self.anew.cache.get_typed::<Model>(&self.keys.snapshot, MODEL)?;
        let model = model.filter(|model| model.check().is_ok());
        let gone = || Failure::retry("the snapshot that they were drawn on has gone, too");
        let (engine, scene) = (self.engine.clone(), self.anew.scene.clone());
        let snapshot = Drawn { model: Arc::new(model.ok_or_else(gone)?), engine, scene, size: self.size };
        let sky = self.skies.read(view)?;
        let drawn = match self.maker.settings.mask_source {
            MaskSource::Render => Some(snapshot.render(view).map_err(Failure::retry)?),
            MaskSource::Photo => None,
        };
        Ok(self.maker.make(view, drawn.as_ref(), &snapshot, sky.as_ref())?)
    }
}

impl FieldInputs for Inputs {
    fn embedding(&self, view: usize) -> Result<Embedding, Failure> {
        let kept = Kept { view, what: "embedding", kind: EMBEDDING, key: &self.keys.embedding[view] };
        self.anew.read(kept, || {
            describe(&*self.embedder, &self.anew.scene.views[view], self.size).map_err(Failure::retry)
        })
    }

    fn visibility(&self, view: usize) -> Result<Mask, Failure> {
        let kept = Kept { view, what: "visibility", kind: VISIBILITY, key: &self.keys.visibility[view] };
        self.anew.read(kept, || self.look(view))
    }

    fn sky(&self, view: usize) -> Result<Option<Mask>, Failure> {
        self.skies.read(view)
    }

    fn masks(&self, view: usize, stopping: &dyn Fn() -> bool) -> Result<Option<MaskSet>, Failure> {
        match self.masks_known.wait(view, stopping) {
            None => Err(Failure::stopped()),
            Some(false) => Ok(None),
            Some(true) => {
                let kept = Kept { view, what: "set of masks", kind: MASKS, key: &self.keys.masks[view] };
                self.anew.read(kept, || self.make_masks(view)).map(Some)
            }
        }
    }
}
