//! Actor that finds skies and makes masks, cached per view.

use crate::{MaskError, MaskSettings, MaskSource, generate, sasm};
use segwild_flow::{Actor, ActorFailure, Cache, Context, Key, Message, Origin, Quarantined, Sender, fault};
use segwild_scene::{Image, LoadedPhoto, Mask, MaskSet, PhotoStore, Pose, ReaderError, SceneError};
use segwild_vision::{MaskProposer, SkyDetector, VisionError};
use std::sync::Arc;
use std::time::Instant;

/// Kind of the cache's mask records.
const MASKS: &str = "masks";
/// Kind of the cache's sky records.
const SKY: &str = "sky";

/// A request to the actor.
#[derive(Clone)]
pub enum MaskTask {
    /// Find the sky of a photo. Send it urgently: training waits for it.
    Sky {
        /// Index of the view.
        view: usize,
        /// Name of the artefact.
        key: Key,
    },
    /// Make the masks of a view.
    Masks {
        /// Index of the view.
        view: usize,
        /// Name of the artefact.
        key: Key,
        /// The scene rendered from the photo's camera: no transients, one light. `None` if it was not rendered in advance.
        render: Option<Arc<Image>>,
        /// The scene that the masks are made from.
        snapshot: Arc<dyn Snapshot>,
        /// The photo's sky, if known.
        sky: Option<Arc<Mask>>,
    },
}

impl Message for MaskTask {
    fn bytes(&self) -> usize {
        let render = match self {
            MaskTask::Masks { render: Some(render), .. } => render.data.len() * 4,
            _ => 0,
        };
        size_of::<Self>() + render
    }

    fn label(&self) -> String {
        match self {
            MaskTask::Sky { view, .. } => format!("sky {view}"),
            MaskTask::Masks { view, .. } => format!("masks {view}"),
        }
    }

    fn again(&self) -> Option<Self> {
        Some(self.clone())
    }
}

/// The scene as it is when the masks are made.
pub trait Snapshot: Send + Sync {
    /// Centres of its splats, for the depth of the prompts.
    fn means(&self) -> &[[f32; 3]];

    /// The pose of a photo's camera in it.
    fn pose(&self, view: usize) -> Pose;

    /// Renders the scene from a photo's camera: planes of RGB in [0, 1].
    fn render(&self, view: usize) -> Result<Image, ReaderError>;
}

/// What the actor sends to its consumer.
pub enum MaskOutcome {
    /// A photo's sky; `Err` says why there is none.
    Sky {
        /// Index of the view.
        view: usize,
        /// The sky's pixels.
        sky: Result<Arc<Mask>, Quarantined>,
        /// Seconds it took; `None` if it was in the cache.
        seconds: Option<f64>,
    },
    /// A view's masks are in the cache; `Err` says why there are none.
    Masks {
        /// Index of the view.
        view: usize,
        /// How many there are.
        masks: Result<usize, Quarantined>,
        /// Seconds they took; `None` if they were in the cache.
        seconds: Option<f64>,
    },
}

/// Makes the masks of a photo.
pub struct MaskMaker {
    /// The photos.
    pub photos: Arc<PhotoStore>,
    /// Proposes masks.
    pub proposer: Arc<dyn MaskProposer>,
    /// How masks are made.
    pub settings: MaskSettings,
    /// The spread of view depths in this scene: what is near and what is far.
    pub depths: sasm::SceneDepths,
}

/// The actor. `O` is what its consumer calls its outcomes.
pub struct MaskActor<O: Message> {
    /// Finds the sky.
    pub sky: Arc<dyn SkyDetector>,
    /// Makes the masks.
    pub maker: Arc<MaskMaker>,
    /// Where artefacts are stored.
    pub cache: Cache,
    /// Where outcomes go.
    pub out: Sender<O>,
}

/// Why there is no sky, or why there are no masks.
#[derive(Debug, thiserror::Error)]
pub enum MaskFailure {
    /// The photo cannot be read.
    #[error(transparent)]
    Photo(#[from] SceneError),
    /// The scene cannot be rendered from the photo's camera.
    #[error("photo {name}: its view cannot be rendered: {reason}")]
    Render {
        /// Name of the photo.
        name: String,
        /// The renderer's error.
        reason: ReaderError,
    },
    /// The sky detector refuses.
    #[error("photo {name}: {reason}")]
    Sky {
        /// Name of the photo.
        name: String,
        /// The detector's error.
        #[source]
        reason: VisionError,
    },
    /// Prompts or masks cannot be made.
    #[error("photo {name}: {reason}")]
    Masks {
        /// Name of the photo.
        name: String,
        /// What is wrong.
        #[source]
        reason: MaskError,
    },
    /// A fault was armed here.
    #[error("{0}")]
    Fault(std::io::Error),
}

impl MaskMaker {
    fn photo(&self, view: usize) -> Result<Arc<LoadedPhoto>, MaskFailure> {
        Ok(self.photos.read(view)?)
    }

    /// Makes the masks of a view. Without a `render`, the snapshot is rendered here if [`MaskSource::Render`] is set.
    ///
    /// # Errors
    /// When the photo cannot be read or the model refuses.
    pub fn make(
        &self,
        view: usize,
        render: Option<&Image>,
        snapshot: &dyn Snapshot,
        sky: Option<&Mask>,
    ) -> Result<MaskSet, MaskFailure> {
        fault::point("masks.make").map_err(MaskFailure::Fault)?;
        let posed = &self.photos.scene().views[view];
        let name = || posed.name.clone();
        let (rendered, photo);
        let image = match (self.settings.mask_source, render) {
            (MaskSource::Render, Some(render)) => render,
            (MaskSource::Render, None) => {
                rendered =
                    snapshot.render(view).map_err(|reason| MaskFailure::Render { name: name(), reason })?;
                &rendered
            }
            (MaskSource::Photo, _) => {
                photo = self.photo(view)?;
                &photo.image
            }
        };
        let camera = posed.camera.resized(image.width as u32, image.height as u32);
        let depth = self.depths.relative(sasm::scene_view_depth(self.photos.scene(), posed));
        let failed = |reason| MaskFailure::Masks { name: name(), reason };
        let plan = sasm::plan(snapshot.means(), &camera, &snapshot.pose(view), depth, sky, &self.settings)
            .map_err(failed)?;
        Ok(generate(&*self.proposer, image, &plan.points, sky, &self.settings).map_err(failed)?.set)
    }
}

impl<O: Message + From<MaskOutcome>> Actor for MaskActor<O> {
    type Message = MaskTask;

    fn label(&self, task: &MaskTask) -> String {
        let (what, view) = match task {
            MaskTask::Sky { view, .. } => ("sky", *view),
            MaskTask::Masks { view, .. } => ("masks", *view),
        };
        self.maker
            .photos
            .scene()
            .views
            .get(view)
            .map_or_else(|| task.label(), |view| format!("{what} {}", view.name))
    }

    fn handle(&mut self, task: MaskTask, _: &Context) -> Result<(), ActorFailure> {
        let began = Instant::now();
        let took = |origin| (origin == Origin::Made).then(|| began.elapsed().as_secs_f64());
        let outcome = match task {
            MaskTask::Sky { view, key } => {
                let (sky, origin) = self.cache.get_or_make(&key, SKY, || {
                    let photo = self.maker.photo(view)?;
                    let (scene, image) = (self.maker.photos.scene(), &photo.image);
                    let seen = scene.points_in(view, image.width, image.height);
                    let failed = |reason| MaskFailure::Sky { name: scene.views[view].name.clone(), reason };
                    self.sky.sky_above(image, &seen).map_err(failed)
                })?;
                MaskOutcome::Sky { view, sky: Ok(Arc::new(sky)), seconds: took(origin) }
            }
            MaskTask::Masks { view, key, render, snapshot, sky } => {
                let (set, origin) = self.cache.get_or_make(&key, MASKS, || {
                    self.maker.make(view, render.as_deref(), &*snapshot, sky.as_deref())
                })?;
                MaskOutcome::Masks { view, masks: Ok(set.masks.len()), seconds: took(origin) }
            }
        };
        self.out.blocking_send(outcome.into())?;
        Ok(())
    }

    fn on_quarantine(
        &mut self,
        task: Option<MaskTask>,
        given_up: &Quarantined,
        _: &Context,
    ) -> Result<(), ActorFailure> {
        let given_up = given_up.clone();
        let outcome = match task {
            Some(MaskTask::Sky { view, .. }) => MaskOutcome::Sky { view, sky: Err(given_up), seconds: None },
            Some(MaskTask::Masks { view, .. }) => {
                MaskOutcome::Masks { view, masks: Err(given_up), seconds: None }
            }
            None => return Ok(()),
        };
        self.out.blocking_send(outcome.into())?;
        Ok(())
    }
}
