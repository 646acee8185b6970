//! Embeddings and the feature field behind a mailbox.

use crate::{
    FeatureError, FeatureField, FeatureSettings, Pca, Progress, Samples, TargetSource, ViewTarget, build,
};
use segwild_flow::{
    Actor, Cache, CacheError, Context, Failure, Key, Message, Origin, Quarantined, Sender, fault,
};
use segwild_raster::{Engine, ProjectOptions};
use segwild_scene::{Embedding, Image, Mask, MaskSet, Scene, Splats};
use segwild_vision::Embedder;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

/// Kind of the cache's embedding records.
const EMBEDDING: &str = "embedding";

/// Kind of the cache's mask records, as the masks actor writes them.
const MASKS: &str = "masks";

/// Kind of the cache's sky records, as the masks actor writes them.
const SKY: &str = "sky";

/// Kind of the cache's records of what can be trusted in a photo: a [`Mask`] on a grid of its own.
pub const VISIBILITY: &str = "visibility";

/// One photo's share in the field, by the names of its artefacts in the cache.
#[derive(Clone, Debug)]
pub struct FieldView {
    /// Index of the view.
    pub view: usize,
    /// Its embedding.
    pub embedding: Key,
    /// Its masks, if it turns out to have any.
    pub masks: Key,
    /// Its sky, if it is known.
    pub sky: Option<Key>,
    /// Which of its pixels can be trusted (VM): a [`VISIBILITY`] record; sky cannot.
    pub visibility: Key,
}

/// Who knows which views have masks, as soon as it is known.
pub trait AwaitedMasks: Send + Sync {
    /// Waits until it is known whether a view's masks are in the cache; `None` when `stopping` says so first.
    fn wait(&self, view: usize, stopping: &dyn Fn() -> bool) -> Option<bool>;
}

/// What the actor is asked for.
#[derive(Clone)]
pub enum FeatureTask {
    /// Describe a photo; the embedding goes to the cache.
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
        /// How they are drawn.
        options: ProjectOptions,
        /// The photos in the order in which they are lifted.
        views: Arc<Vec<FieldView>>,
        /// Their masks may still be under way: lifting does without them.
        masks: Arc<dyn AwaitedMasks>,
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

/// What the actor sends on.
pub enum FeatureOutcome {
    /// A photo's embedding is in the cache.
    Embedded {
        /// Index of the view.
        view: usize,
        /// Seconds it took; `None` if it was there.
        seconds: Option<f64>,
    },
    /// A photo could not be described.
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
    /// The scene.
    pub scene: Arc<Scene>,
    /// Long side at which photos are looked at.
    pub size: u32,
    /// Describes photos.
    pub embedder: Arc<dyn Embedder>,
    /// Draws features.
    pub engine: Arc<dyn Engine>,
    /// Where artefacts are.
    pub cache: Cache,
    /// How the field is made.
    pub settings: FeatureSettings,
    /// Where outcomes go.
    pub out: Sender<O>,
}

/// Targets read from the cache when they are needed.
struct CachedTargets<'a> {
    scene: &'a Scene,
    cache: &'a Cache,
    views: &'a [FieldView],
    pca: &'a Pca,
    learned: bool,
    masks: &'a dyn AwaitedMasks,
    context: &'a Context,
}

fn missing(name: &str, what: &str, error: Option<CacheError>) -> FeatureError {
    let why = error.map_or_else(|| "it is gone from the cache; run again".to_owned(), |e| e.to_string());
    FeatureError::Shape(format!("{name}: {what} cannot be read: {why}"))
}

fn load_mask(cache: &Cache, name: &str, what: &str, kind: &str, key: &Key) -> Result<Mask, FeatureError> {
    cache
        .get_typed(key, kind)
        .map_err(|e| missing(name, what, Some(e)))?
        .ok_or_else(|| missing(name, what, None))
}

/// VM as a plane in [0, 1].
fn load_validity(cache: &Cache, name: &str, key: &Key) -> Result<Image, FeatureError> {
    let mask = load_mask(cache, name, "what can be trusted in it", VISIBILITY, key)?;
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let data = (0..width * height).map(|i| f32::from(u8::from(mask.index(i)))).collect();
    Ok(Image { width, height, channels: 1, data })
}

fn load_embedding(cache: &Cache, name: &str, key: &Key) -> Result<Embedding, FeatureError> {
    match cache.get_typed(key, EMBEDDING) {
        Ok(Some(embedding)) => Ok(embedding),
        Ok(None) => Err(missing(name, "its embedding", None)),
        Err(error) => Err(missing(name, "its embedding", Some(error))),
    }
}

impl TargetSource for CachedTargets<'_> {
    fn len(&self) -> usize {
        self.views.len()
    }

    fn load(&self, index: usize) -> Result<Arc<ViewTarget>, FeatureError> {
        let field = &self.views[index];
        let view = &self.scene.views[field.view];
        let embedding = load_embedding(self.cache, &view.name, &field.embedding)?;
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
            validity: load_validity(self.cache, &view.name, &field.visibility)?,
            masks: MaskSet { width: view.camera.width, height: view.camera.height, masks: Vec::new() },
        }))
    }

    fn masks(&self, index: usize, none: &ViewTarget) -> Result<MaskSet, FeatureError> {
        let FieldView { view, masks, .. } = &self.views[index];
        let name = &self.scene.views[*view].name;
        match self.masks.wait(*view, &|| self.context.stopping()) {
            // A stop; who asked looks at that, too.
            None => Err(missing(name, "its masks", None)),
            Some(false) => Ok(none.masks.clone()),
            Some(true) => self
                .cache
                .get_typed::<MaskSet>(masks, MASKS)
                .map_err(|e| missing(name, "its masks", Some(e)))?
                .ok_or_else(|| missing(name, "its masks", None)),
        }
    }
}

impl<O: Message + From<FeatureOutcome>> FeatureActor<O> {
    fn embed(&self, view: usize, key: &Key) -> Result<Option<f64>, Failure> {
        let posed = &self.scene.views[view];
        let began = Instant::now();
        let (_, origin) = self.cache.get_or_make(key, EMBEDDING, || -> Result<Embedding, Refused> {
            let photo = posed.load(self.size).map_err(|e| Refused(e.to_string()))?;
            self.embedder.embed(&photo.image).map_err(|e| Refused(format!("photo {}: {e}", posed.name)))
        })?;
        Ok((origin == Origin::Made).then(|| began.elapsed().as_secs_f64()))
    }

    fn field(
        &self,
        splats: &Splats,
        options: &ProjectOptions,
        views: &[FieldView],
        masks: &dyn AwaitedMasks,
        context: &Context,
    ) -> Result<FeatureField, FeatureError> {
        let mut samples =
            Samples::new(self.settings.pca_samples as usize, views.len(), self.settings.feature_seed);
        for field in views {
            let name = &self.scene.views[field.view].name;
            let embedding = load_embedding(&self.cache, name, &field.embedding)?;
            let validity = load_validity(&self.cache, name, &field.visibility)?;
            let sky = match &field.sky {
                Some(key) => Some(load_mask(&self.cache, name, "its sky", SKY, key)?),
                None => None,
            };
            samples.add(field.view, name, &embedding, Some(&validity), sky.as_ref())?;
            context.progress();
        }
        let pca = samples.fit(self.settings.channels as usize, self.settings.keep_variance)?;
        context.events().info(
            Some("features"),
            format!(
                "{} channels keep {:.1} % of the embedding's variance",
                pca.channels,
                100.0 * pca.explained_variance()
            ),
        );
        let targets = CachedTargets {
            scene: &self.scene,
            cache: &self.cache,
            views,
            pca: &pca,
            learned: self.settings.compression == crate::Compression::Learned,
            masks,
            context,
        };
        let total = views.len() as u64 + u64::from(self.settings.refine_steps);
        let mut progress = context.events().stage("features", Some(total));
        let mut broken = None;
        let field = build(&*self.engine, splats, &targets, &pca, &self.settings, options, &mut |step| {
            context.progress();
            broken = broken.take().or_else(|| fault::point("features.step").err());
            progress.advance(1);
            if let Progress::Refined { done, embedding, compact, .. } = step
                && done % 20 == 0
            {
                context.events().metric(
                    "features",
                    "embedding_loss",
                    f64::from(embedding),
                    Some(done as u64),
                );
                context.events().metric("features", "compact_loss", f64::from(compact), Some(done as u64));
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

/// A failure in words.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Refused(String);

impl<O: Message + From<FeatureOutcome>> Actor for FeatureActor<O> {
    type Message = FeatureTask;

    fn handle(&mut self, task: FeatureTask, context: &Context) -> Result<(), Failure> {
        let outcome = match task {
            FeatureTask::Embed { view, key } => {
                let seconds = self.embed(view, &key)?;
                FeatureOutcome::Embedded { view, seconds }
            }
            FeatureTask::Field { splats, options, views, masks } => {
                let field = self.field(&splats, &options, &views, &*masks, context);
                context.check()?; // a refinement cut short is no field
                match field {
                    Ok(field) => FeatureOutcome::Field(Box::new(field)),
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
    ) -> Result<(), Failure> {
        let given_up = given_up.clone();
        let outcome = match task {
            Some(FeatureTask::Embed { view, .. }) => FeatureOutcome::EmbedFailed { view, given_up },
            _ => FeatureOutcome::FieldFailed(given_up.error),
        };
        self.out.blocking_send(outcome.into())?;
        Ok(())
    }
}
