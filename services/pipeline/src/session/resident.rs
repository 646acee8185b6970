//! A run's scene, kept in memory.

use super::answer::{PendingAnswer, failed};
use super::kept_masks::{KeptMasks, MASK_BYTES};
use crate::accelerator::leased;
use crate::artifacts::folder::{Loaded, TrainingSnapshot};
use crate::artifacts::images::ImageFiles;
use crate::artifacts::photo_boundaries::PhotoBoundaries;
use crate::artifacts::photo_cache::RunPhotoCache;
use crate::artifacts::prompts::check_all;
use crate::artifacts::scene_tree::TreeSource;
use crate::code::{Code, providers_for};
use crate::output::light::{self, find};
use crate::output::objects::ListRequest;
use crate::output::text_query::{DescribeRequest, PartlyDescribed};
use crate::run::skies;
use crate::{
    ObjectQuery, PhotoPrompts, Replay, RunError, RunFolder, Settings, TextRanking, choose_engine, log_loss,
    transients,
};
use segwild_flow::{ActorOptions, Cache, Limits, Phase, Sender, Stopper, System, SystemOptions, mailbox};
use segwild_objective::Engine;
use segwild_raster::CpuEngine;
use segwild_scene::{PhotoStore, Prompts, ReaderError, Scene, Splats};
use segwild_segmenter::scene_tree::{GroupCandidate, SceneTree};
use segwild_segmenter::{
    PosedView, SceneGraph, SegmentActor, SegmentError, SegmentReply, SegmentSettings, SegmentTask,
    SplatFeatures, ViewSplats,
};
use segwild_trainer::Model;
use segwild_vision::Providers;
use std::sync::atomic::AtomicUsize;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

/// How a session is opened.
pub struct SessionOptions {
    /// Turns prompts into masks; `None`: the providers of [`crate::providers_for`].
    pub providers: Option<Providers>,
    /// The networks and services for those.
    pub code: Code,
    /// Whether clicks are answered from the scene tree. It is read from the run's cache, or grown.
    pub tree: bool,
    /// Neighbours of a splat in the graph that clicks need ([`SegmentSettings::neighbours`]), for a session that has
    /// many: it is made while the session opens, and then what each photo shows, until a click comes. `None`: by the first
    /// click.
    pub neighbours: Option<usize>,
    /// Ends the growing of the tree.
    pub stopper: Stopper,
}

impl Default for SessionOptions {
    fn default() -> Self {
        let (code, stopper) = (Code::given(&[]), Stopper::new());
        SessionOptions { providers: None, code, tree: true, neighbours: None, stopper }
    }
}

/// Bytes of decoded photos that a session keeps.
pub(super) const PHOTO_BYTES: usize = 192 << 20;

/// A run's scene, kept in memory for prompts.
pub struct Session {
    pub(super) folder: RunFolder,
    /// The settings that the run was made with.
    pub(super) made_with: Settings,
    pub(super) scene: Arc<Scene>,
    /// Its photos, at working size: every click reads all of them, round after round.
    pub(super) photos: Arc<PhotoStore>,
    pub(super) model: Model,
    /// Hash of its splats, once a file has needed it.
    pub(super) digest: OnceLock<String>,
    /// Its splats, for those that outlast a request or work beside it: the segmenter, and clients that take them slowly.
    pub(super) splats: Arc<Splats>,
    /// Bytes that the segmenter's features take.
    pub(super) feature_bytes: usize,
    /// Bytes that the segmenter keeps from click to click: its neighbour graph, affinities, and what each photo shows.
    pub(super) segmenter_bytes: Arc<AtomicUsize>,
    pub(super) engine: Arc<dyn Engine>,
    /// Renders which splat is in front at each pixel; the buffers of one view are used again from view to view.
    pub(super) fronts: CpuEngine,
    pub(super) providers: Providers,
    /// Key of the training.
    pub(super) training: Option<String>,
    pub(super) tree: Option<KeyedTree>,
    /// What texts that were cancelled have embedded of the tree's groups.
    pub(super) described: PartlyDescribed,
    /// Names of the image files of each photo.
    pub(super) files: ImageFiles,
    pub(super) tasks: Sender<SegmentTask>,
    pub(super) system: System,
}

/// A scene tree and its key in the cache.
pub(super) struct KeyedTree {
    pub(super) key: String,
    pub(super) tree: Arc<SceneTree>,
}

impl Session {
    /// Loads a run.
    ///
    /// # Errors
    /// When the run cannot be read, or `options.stopper` stops it.
    pub fn open(folder: &RunFolder, options: SessionOptions) -> Result<Session, RunError> {
        // Clicks do without a tree where no ledger names the training.
        let training = folder.training_key();
        Session::of(folder, folder.load()?, training, options)
    }

    /// Loads a run that is still trained, as it was at a snapshot. It has no scene tree: clicks are answered by the photos.
    ///
    /// # Errors
    /// When the snapshot cannot be read: a newer one may have replaced it.
    pub fn open_snapshot(
        folder: &RunFolder,
        snapshot: &TrainingSnapshot,
        options: SessionOptions,
    ) -> Result<Session, RunError> {
        Session::of(folder, folder.load_snapshot(snapshot)?, None, options)
    }

    /// A session of a loaded run; `training` is the key of its training, if that is over.
    fn of(
        folder: &RunFolder,
        loaded: Loaded,
        training: Option<String>,
        options: SessionOptions,
    ) -> Result<Session, RunError> {
        let Loaded { settings: made_with, scene, model, field } = loaded;
        let SessionOptions { providers, code, tree, neighbours, stopper } = options;
        let providers = match providers {
            Some(providers) => providers,
            None => providers_for(folder, &code)?,
        };
        let providers = leased(&providers);
        let size = made_with.scene.size;
        let engine = choose_engine(&made_with.run, log_loss)?.engine;
        let features = match field {
            Some(field) => {
                let mut features = SplatFeatures::of(field.rows);
                features.upload(&*engine)?;
                Some(Arc::new(features))
            }
            None => None,
        };
        let feature_bytes = features.as_ref().map_or(0, |features| features.bytes());
        let scene = Arc::new(scene);
        // A folder that cannot be written is no obstacle: its photos are decoded again.
        let cache = Cache::at(folder.path().join("cache"));
        let cached = Arc::new(RunPhotoCache::new(cache, &scene, size));
        let photos = Arc::new(cached.store(PHOTO_BYTES));
        let tree = match training.as_ref().filter(|_| tree) {
            Some(geometry) => {
                let boundaries = PhotoBoundaries::of_run(&*providers.segmenter, folder, &scene)?;
                let source = TreeSource { photos: &photos, model: &model, geometry, boundaries };
                let tree = source.tree(&folder.cache()?, &|| stopper.phase() != Phase::Running)?;
                tree.map(|tree| KeyedTree { key: source.key().to_string(), tree: Arc::new(tree) })
            }
            None => None,
        };
        let store = photos.clone();
        let read = move |view: usize| match store.read(view) {
            Ok(photo) => Ok(photo.image.clone()),
            Err(error) => Err(ReaderError::from(error)),
        };
        let read = Arc::new(read);
        let system = System::new(SystemOptions {
            threads: made_with.run.threads as usize,
            ..SystemOptions::default()
        })?;
        let (tasks, inbox) = mailbox::<SegmentTask>("segmenter", Limits::default());
        let views = scene.views.iter().map(|v| PosedView { camera: v.camera.scaled_to(size), ..v.into() });
        let views: Arc<Vec<PosedView>> = Arc::new(views.collect());
        let barred: Arc<Vec<bool>> = Arc::new(scene.views.iter().map(|v| v.test).collect());
        let found = skies::of_run(folder, photos.clone(), providers.sky.clone())?;
        let kept = KeptMasks::within(MASK_BYTES);
        // The cache's skies are known by their keys: they stay as they are.
        let skies = Arc::new(move |view: usize| kept.read(view, (), || found(view)));
        let found = transients::of_run(folder, &scene);
        let version = transients::versions_of_run(folder, &scene);
        let kept = KeptMasks::within(MASK_BYTES);
        let transients = Arc::new(move |view: usize| match version(view) {
            Some(version) => kept.read(view, version, || found(view)),
            None => found(view),
        });
        let splats = model.splats.clone();
        let (options, segmenter) = (model.options(), providers.segmenter.clone());
        let engine_of_actor = engine.clone();
        let splats_of_actor = splats.clone();
        let tree_of_actor = tree.as_ref().map(|keyed| keyed.tree.clone());
        let segmenter_bytes = Arc::new(AtomicUsize::new(0));
        let bytes = segmenter_bytes.clone();
        system.spawn(inbox, ActorOptions { attempts: 1, ..ActorOptions::default() }, move || {
            let shown = ViewSplats::new(splats_of_actor.len(), views.len());
            let known = tree_of_actor.as_ref().filter(|tree| tree.shown_by.len() == splats_of_actor.len());
            let actor = SegmentActor {
                engine: engine_of_actor.clone(),
                options,
                splats: splats_of_actor.clone(),
                views: views.clone(),
                barred: barred.clone(),
                features: features.clone(),
                photos: read.clone(),
                skies: skies.clone(),
                transients: transients.clone(),
                segmenter: segmenter.clone(),
                tree: tree_of_actor.clone(),
                seen_once: known.map(|tree| tree.seen_once()),
                graph: match neighbours {
                    Some(neighbours) => SceneGraph::new(&splats_of_actor, neighbours),
                    None => SceneGraph::default(),
                },
                ahead: match (&shown, neighbours) {
                    (Some(shown), Some(_)) => shown.ahead(),
                    _ => 0..0,
                },
                shown,
                bytes: bytes.clone(),
            };
            actor.count_bytes();
            Ok(actor)
        })?;
        let files = ImageFiles::of(scene.views.iter().map(|v| v.name.as_str()));
        let folder = folder.clone();
        Ok(Session {
            folder,
            made_with,
            scene,
            photos,
            model,
            digest: OnceLock::new(),
            splats,
            feature_bytes,
            segmenter_bytes,
            engine,
            fronts: CpuEngine::new().keeping(1),
            providers,
            training,
            tree,
            described: PartlyDescribed::default(),
            files,
            tasks,
            system,
        })
    }

    /// The provider of the masks: `built-in`, or `sam:` and a model's name.
    pub fn provider(&self) -> &str {
        &self.providers.name
    }

    /// The run's photos and cameras.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The trained scene.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// The scene tree; `None` where none was requested, where the training is not over, and where the masks that it is grown from
    /// have gone from the cache.
    pub fn tree(&self) -> Option<&Arc<SceneTree>> {
        self.tree.as_ref().map(|keyed| &keyed.tree)
    }

    /// Key of the training that the scene is of; `None` where no ledger names it.
    pub fn training(&self) -> Option<&str> {
        self.training.as_deref()
    }

    /// The run's folder.
    pub fn folder(&self) -> &RunFolder {
        &self.folder
    }

    /// What the list of the scene's objects is made of.
    pub(crate) fn list_request(&self) -> Result<ListRequest<'_>, RunError> {
        let Some(KeyedTree { key, tree }) = &self.tree else {
            return Err(RunError::Request(
                "this run has no scene tree, so that its objects cannot be listed: `segwild run` with the same folder grows it".into(),
            ));
        };
        let (engine, photos, model) = (&self.fronts, &*self.photos, &self.model);
        Ok(ListRequest { engine, photos, model, tree, key: key.clone() })
    }

    /// Whether a model of texts is here, for [`Session::rank_text`].
    pub fn answers_texts(&self) -> bool {
        self.providers.texts.is_some()
    }

    /// Ranks the groups of the scene by a text. The first text crops and embeds them, which takes up to a minute; after that a text
    /// costs its own embedding.
    ///
    /// # Errors
    /// When the text cannot be used, no model of texts is here, the run has no scene tree, or `stopper` stops it.
    pub fn rank_text(&self, text: &str, stopper: &Stopper) -> Result<TextRanking, RunError> {
        TextRanking::check(text)?;
        let embedder = self.providers.text_embedder()?;
        let scene = self.list_request()?;
        let tree = scene.tree;
        let transients = transients::of_run(&self.folder, &self.scene);
        let request = DescribeRequest {
            scene,
            embedder,
            transients: &transients,
            transients_digest: transients::digest_of_run(&self.folder, &self.scene),
            so_far: &self.described,
        };
        let described = request.groups(&self.folder.cache()?, stopper)?;
        let photos: Vec<&str> = self.scene.views.iter().map(|view| view.name.as_str()).collect();
        TextRanking::of(text, &described, tree, &photos, embedder, stopper)
    }

    /// Asks for the object of the prompts, for one of the scene's list, or for what a text describes: the setting `alternative` says
    /// which match of the text. Queries are answered one after the other; `cancel` ends this one.
    ///
    /// # Errors
    /// When the prompts cannot be used, the list is of an earlier training, the text cannot be ranked
    /// ([`Session::rank_text`]), or the session has ended.
    pub fn ask(
        &self,
        replay: &Replay,
        settings: &SegmentSettings,
        cancel: &Stopper,
    ) -> Result<PendingAnswer, RunError> {
        let began = Instant::now();
        let ranking = replay.text.as_ref().map(|text| self.rank_text(text, cancel)).transpose()?;
        let by_text = ranking.as_ref().and_then(|ranking| ranking.selected(settings.alternative));
        let (prompts, group) = match (by_text, &replay.object) {
            (Some(found), _) => {
                let views = found.views.iter().map(|&view| (view, Prompts::default()));
                (views.collect(), Some(found.meant.clone()))
            }
            (None, Some(object)) => {
                let (view, group) = self.listed(object)?;
                (vec![(view, Prompts::default())], Some(group))
            }
            (None, None) => {
                check_all(&replay.prompts)?;
                let mut queries: Vec<(usize, Prompts)> = Vec::new();
                for p in &replay.prompts {
                    let (view, mut prompts) = self.query(p)?;
                    // A photo that is named twice is one photo.
                    match queries.iter_mut().find(|(other, _)| *other == view) {
                        Some((_, all)) => {
                            all.points.append(&mut prompts.points);
                            all.boxes.append(&mut prompts.boxes);
                            all.granularity = all.granularity.or(prompts.granularity);
                        }
                        None => queries.push((view, prompts)),
                    }
                }
                (queries, None)
            }
        };
        if prompts.is_empty() {
            return Err(SegmentError::NoPrompt.into());
        }
        // An unknown photo is reported at once.
        light::requested(&settings.object_appearance).lights(&self.scene, &self.model)?;
        let (reply, answers) = mailbox::<SegmentReply>("answers", Limits::default());
        let task = SegmentTask { prompts, group, settings: settings.clone(), cancel: cancel.clone(), reply };
        self.tasks.blocking_send_urgent(task).map_err(|e| failed(e.to_string()))?;
        Ok(PendingAnswer {
            replay: Replay { settings: Some(settings.clone()), ..replay.clone() },
            ranking,
            scene: self.scene.clone(),
            size: self.made_with.scene.size,
            began,
            observer: self.system.observer(),
            stoppers: [cancel.clone(), self.system.stopper()],
            answers,
        })
    }

    /// The view that shows an object of the scene's list best, and its group.
    fn listed(&self, object: &ObjectQuery) -> Result<(usize, GroupCandidate), RunError> {
        let request = self.list_request()?;
        if object.tree != request.key {
            return Err(RunError::Request(
                "the scene has been trained again since its objects were listed: `segwild objects RUN` lists them again".into(),
            ));
        }
        let group = request.tree.parts().groups.into_iter().nth(object.number.wrapping_sub(1));
        let none = || RunError::Request(format!("there is no object {}", object.number));
        Ok((find(&self.scene, &object.photo)?, group.ok_or_else(none)?))
    }

    /// The view of a photo's prompts, and the prompts in pixels of the view at working size.
    fn query(&self, p: &PhotoPrompts) -> Result<(usize, Prompts), RunError> {
        let index = find(&self.scene, &p.photo)?;
        let view = &self.scene.views[index];
        let (full, small) = (&view.camera, view.camera.scaled_to(self.made_with.scene.size));
        for point in &p.prompts.points {
            if !full.contains(glam::Vec2::new(point.x, point.y)) {
                let (photo, x, y) = (p.photo.clone(), point.x, point.y);
                let (width, height) = (full.width, full.height);
                return Err(SegmentError::OutsideFrame { photo, x, y, width, height }.into());
            }
        }
        let inner = view.prompts_from_taken(&p.prompts).map_err(|[x, y]| {
            RunError::Request(format!(
                "photo {}: ({x}, {y}) lies where the lens bends the photo out of the undistorted one that is worked with; click \
                 nearer to the middle",
                p.photo
            ))
        })?;
        let Some(framed) = inner.within(full.width as f32, full.height as f32) else {
            return Err(RunError::Request(format!(
                "photo {}: a box lies outside of it ({} x {} pixels)",
                p.photo, full.width, full.height
            )));
        };
        let (sx, sy) = (small.width as f32 / full.width as f32, small.height as f32 / full.height as f32);
        Ok((index, framed.scaled(sx, sy)))
    }
}
