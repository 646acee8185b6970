//! Actor that computes embeddings and the feature field.

use crate::{
    EmbeddingSamples, FeatureError, FeatureField, FeatureSettings, Pca, Progress, TargetSource, ViewTarget,
    build,
};
use segwild_flow::{Actor, ActorFailure, Cache, Context, Key, Message, Origin, Quarantined, Sender, fault};
use segwild_objective::Engine;
use segwild_raster::ProjectOptions;
use segwild_scene::{Embedding, Image, Mask, MaskSet, PhotoStore, Scene, SceneError, Splats};
use segwild_vision::{Embedder, VisionError};
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

/// Kind of the cache's embedding records.
pub const EMBEDDING: &str = "embedding";

/// The inputs of the feature field. Each is read when it is needed, so that only indexes grow with the number of photos.
pub trait FieldInputs: Send + Sync {
    /// The scene as it was trained.
    fn scene(&self) -> &Scene;

    /// The photo's embedding.
    ///
    /// # Errors
    /// Here and below: when it was there and can no longer be read.
    fn embedding(&self, view: usize) -> Result<Embedding, ActorFailure>;

    /// Which of its pixels can be trusted (visibility map, VM), on a grid of its own; sky cannot.
    fn visibility(&self, view: usize) -> Result<Mask, ActorFailure>;

    /// Its sky, if it is known.
    fn sky(&self, view: usize) -> Result<Option<Mask>, ActorFailure>;

    /// Its masks, as soon as it is known whether there are any; `None` if they were given up. Stops waiting when
    /// `stopping` returns true.
    fn masks(&self, view: usize, stopping: &dyn Fn() -> bool) -> Result<Option<MaskSet>, ActorFailure>;
}

/// A request to the actor.
#[derive(Clone)]
pub enum FeatureTask {
    /// Embed a photo; the embedding goes to the cache.
    Embed {
        /// Index of the view.
        view: usize,
        /// Name of the artefact.
        key: Key,
    },
    /// Make the feature field of a trained scene.
    Field {
        /// The splats.
        splats: Arc<Splats>,
        /// How they are projected.
        options: ProjectOptions,
        /// The photos in the order in which they are lifted.
        views: Arc<Vec<usize>>,
        /// The inputs of each photo. Its masks may still be under way: lifting does without them.
        inputs: Arc<dyn FieldInputs>,
    },
}

impl Message for FeatureTask {
    fn label(&self) -> String {
        match self {
            FeatureTask::Embed { view, .. } => format!("embed {view}"),
            FeatureTask::Field { .. } => "field".into(),
        }
    }

    fn again(&self) -> Option<Self> {
        Some(self.clone())
    }
}

/// What the actor sends to its consumer.
pub enum FeatureOutcome {
    /// A photo's embedding is in the cache.
    Embedded {
        /// Index of the view.
        view: usize,
        /// Seconds it took; `None` if it was there.
        seconds: Option<f64>,
    },
    /// A photo could not be embedded.
    EmbedFailed {
        /// Index of the view.
        view: usize,
        /// Why, and how often it was tried.
        given_up: Quarantined,
    },
    /// The field is done.
    Field(Box<FeatureField>),
    /// It cannot be made.
    FieldFailed(String),
}

/// The actor. `O` is what its consumer calls its outcomes.
pub struct FeatureActor<O: Message> {
    /// The photos.
    pub photos: Arc<PhotoStore>,
    /// Embeds photos.
    pub embedder: Arc<dyn Embedder>,
    /// Renders features.
    pub engine: Arc<dyn Engine>,
    /// Where artefacts are stored.
    pub cache: Cache,
    /// How the field is made.
    pub settings: FeatureSettings,
    /// Where outcomes go.
    pub out: Sender<O>,
}

/// Why a photo cannot be embedded.
#[derive(Debug, thiserror::Error)]
pub enum EmbedError {
    /// It cannot be read.
    #[error(transparent)]
    Photo(#[from] SceneError),
    /// The model refuses it.
    #[error("photo {name}: {reason}")]
    Model {
        /// Name of the photo.
        name: String,
        /// The model's error.
        #[source]
        reason: VisionError,
    },
}

/// Embeds a photo.
///
/// # Errors
/// The photo cannot be read, or the model refuses.
pub fn describe(embedder: &dyn Embedder, photos: &PhotoStore, view: usize) -> Result<Embedding, EmbedError> {
    let photo = photos.read(view)?;
    let refused = |reason| EmbedError::Model { name: photos.scene().views[view].name.clone(), reason };
    embedder.embed(&photo.image).map_err(refused)
}

/// Targets, made from the field's inputs when they are needed.
struct InputTargets<'a> {
    scene: &'a Scene,
    inputs: &'a dyn FieldInputs,
    views: &'a [usize],
    pca: &'a Pca,
    learned: bool,
    context: &'a Context,
}

/// VM as a plane in [0, 1].
fn plane(mask: &Mask) -> Image {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let data = (0..width * height).map(|i| f32::from(u8::from(mask.index(i)))).collect();
    Image { width, height, channels: 1, data }
}

impl TargetSource for InputTargets<'_> {
    fn len(&self) -> usize {
        self.views.len()
    }

    fn load(&self, index: usize) -> Result<Arc<ViewTarget>, FeatureError> {
        let view = &self.scene.views[self.views[index]];
        let embedding = self.inputs.embedding(self.views[index])?;
        let target = if self.learned {
            let Embedding { width, height, channels, data } = embedding;
            Image { width, height, channels, data }
        } else {
            self.pca.encode(&view.name, &embedding)?
        };
        Ok(Arc::new(ViewTarget {
            name: view.name.clone(),
            camera: view.camera,
            pose: view.pose,
            target,
            validity: plane(&self.inputs.visibility(self.views[index])?),
            masks: MaskSet { width: view.camera.width, height: view.camera.height, masks: Vec::new() },
        }))
    }

    fn masks(&self, index: usize, none: &ViewTarget) -> Result<MaskSet, FeatureError> {
        let masks = self.inputs.masks(self.views[index], &|| self.context.stopping())?;
        Ok(masks.unwrap_or_else(|| none.masks.clone()))
    }
}

impl<O: Message + From<FeatureOutcome>> FeatureActor<O> {
    fn embed(&self, view: usize, key: &Key) -> Result<Option<f64>, ActorFailure> {
        let began = Instant::now();
        let make = || describe(&*self.embedder, &self.photos, view);
        let (_, origin) = self.cache.get_or_make(key, EMBEDDING, make)?;
        Ok((origin == Origin::Made).then(|| began.elapsed().as_secs_f64()))
    }

    fn field(
        &self,
        splats: &Splats,
        options: &ProjectOptions,
        views: &[usize],
        inputs: &dyn FieldInputs,
        context: &Context,
    ) -> Result<FeatureField, FeatureError> {
        let mut samples = EmbeddingSamples::new(
            self.settings.pca_samples as usize,
            views.len(),
            self.settings.feature_seed,
        );
        for &view in views {
            let name = &self.photos.scene().views[view].name;
            let (embedding, validity) = (inputs.embedding(view)?, plane(&inputs.visibility(view)?));
            samples.add(view, name, &embedding, Some(&validity), inputs.sky(view)?.as_ref())?;
            context.progress();
        }
        let pca = samples.fit(self.settings.channels as usize, self.settings.keep_variance)?;
        let kept = format!(
            "{} channels keep {:.1} % of the embedding's variance",
            pca.channels,
            100.0 * pca.explained_variance()
        );
        let requested = self.settings.channels as usize;
        let fewer = format!("; it has no more, so not all of the {requested} requested ones are filled");
        let fewer = if pca.channels < requested && self.settings.keep_variance >= 1.0 { &*fewer } else { "" };
        context.events().info(Some("features"), kept + fewer);
        let targets = InputTargets {
            scene: inputs.scene(),
            inputs,
            views,
            pca: &pca,
            learned: self.settings.compression == crate::Compression::Learned,
            context,
        };
        let total = views.len() as u64 + u64::from(self.settings.refine_steps);
        let mut progress = context.events().stage("features", Some(total));
        let mut broken = None;
        let field = build(&*self.engine, splats, &targets, &pca, &self.settings, options, &mut |step| {
            context.progress();
            broken = broken.take().or_else(|| fault::point("features.step").err());
            progress.advance(1);
            if let Progress::Refined { done, losses: Some(losses), .. } = step {
                let metrics = [("embedding_loss", losses.embedding), ("compact_loss", losses.compact)];
                for (name, loss) in metrics {
                    context.events().metric("features", name, f64::from(loss), Some(done as u64));
                }
            }
            if context.stopping() || broken.is_some() {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        })?;
        if let Some(error) = broken {
            return Err(FeatureError::Shape(error.to_string()));
        }
        progress.finish();
        Ok(field)
    }
}

impl<O: Message + From<FeatureOutcome>> Actor for FeatureActor<O> {
    type Message = FeatureTask;

    fn label(&self, task: &FeatureTask) -> String {
        let view = match task {
            FeatureTask::Embed { view, .. } => self.photos.scene().views.get(*view),
            FeatureTask::Field { .. } => None,
        };
        view.map_or_else(|| task.label(), |view| format!("embed {}", view.name))
    }

    fn handle(&mut self, task: FeatureTask, context: &Context) -> Result<(), ActorFailure> {
        let outcome = match task {
            FeatureTask::Embed { view, key } => {
                let seconds = self.embed(view, &key)?;
                FeatureOutcome::Embedded { view, seconds }
            }
            FeatureTask::Field { splats, options, views, inputs } => {
                let field = self.field(&splats, &options, &views, &*inputs, context);
                context.check()?; // a refinement cut short is no field
                match field {
                    Ok(field) => FeatureOutcome::Field(Box::new(field)),
                    Err(FeatureError::Input(failure)) if failure.is_storage() => return Err(failure),
                    Err(error) => FeatureOutcome::FieldFailed(error.to_string()),
                }
            }
        };
        self.out.blocking_send(outcome.into())?;
        Ok(())
    }

    fn on_quarantine(
        &mut self,
        task: Option<FeatureTask>,
        given_up: &Quarantined,
        _: &Context,
    ) -> Result<(), ActorFailure> {
        let given_up = given_up.clone();
        let outcome = match task {
            Some(FeatureTask::Embed { view, .. }) => FeatureOutcome::EmbedFailed { view, given_up },
            _ => FeatureOutcome::FieldFailed(given_up.error),
        };
        self.out.blocking_send(outcome.into())?;
        Ok(())
    }
}
