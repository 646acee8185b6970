//! The actor of the segmenter. It keeps the scene and its neighbour graph, so that the next click is quick.

use crate::confidence::TreeOpinion;
use crate::graph::MOST_NEIGHBOURS;
use crate::photo_agreement::measure;
use crate::scene_tree::{CorrectedLeaves, GroupCandidate, SceneTree};
use crate::tree_answer::{self, TreeAnswer, refuses};
use crate::view_splats::SplatSet;
use crate::{
    Alternative, AnswerStep, AnswerSteps, ClickHits, MaskReader, PosedView, PromptedView, Refiner, Request,
    SceneGraph, SegmentError, SegmentSettings, Selection, SelectionConfidence, SpikeCut, SplatFeatures,
    ViewSplats, cut, select,
};
use segwild_flow::{Actor, ActorFailure, Context, Idle, Message, Phase, Sender, Stopper, lock};
use segwild_objective::Engine;
use segwild_raster::ProjectOptions;
use segwild_scene::{Image, Mask, Prompts, ReaderError, ScoredMask, Splats};
use segwild_vision::{PromptSegmenter, Prompted, VisionError};
use std::collections::HashMap;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

/// Reads the photo of a view at the size in which prompts are given.
pub type PhotoReader = dyn Fn(usize) -> Result<Image, ReaderError> + Send + Sync;

/// Prompts on one or several photos, and where the answer goes.
pub struct SegmentTask {
    /// Views and the prompts on each, in pixels of the photo at working size.
    pub prompts: Vec<(usize, Prompts)>,
    /// The group of the scene tree that is meant: the prompts are empty then, and their views draw its outline.
    pub group: Option<GroupCandidate>,
    /// The settings of this selection.
    pub settings: SegmentSettings,
    /// Ends the work on it, when nobody waits for the answer any more.
    pub cancel: Stopper,
    /// Where the answers go.
    pub reply: Sender<SegmentReply>,
}

impl Message for SegmentTask {
    fn label(&self) -> String {
        format!("{} photos prompted", self.prompts.len())
    }
}

/// What the prompts select.
pub struct Segmented {
    /// The selection.
    pub selection: Selection,
    /// Its spikes, cut.
    pub cut: SpikeCut,
    /// Per photo with a positive prompt, the mask of its prompts.
    pub masks: Vec<(usize, ScoredMask)>,
    /// The expected IoU of the scene tree's answer with what the clicks mean, by its fit on other scenes, in [0, 1]; `None` where
    /// the photos' own masks answered.
    pub expected_iou: Option<f32>,
    /// What the clicks may select, in the order of [`SegmentSettings::alternative`]. Empty where the scene tree took no part.
    pub alternatives: Vec<Alternative>,
    /// How sure the selection is.
    pub confidence: SelectionConfidence,
}

/// The answers to a [`SegmentTask`].
pub enum SegmentReply {
    /// An earlier answer: whether each splat belongs to the object. Left out where the mailbox is full.
    Step(AnswerStep, Vec<bool>),
    /// The labels of the last one, and its spikes, cut, before it is known how sure it is ([`AnswerStep::Selected`]). Left out
    /// where the mailbox is full.
    Selected(Vec<bool>, SpikeCut),
    /// The last one.
    Done(Result<Box<Segmented>, SegmentError>),
}

impl Message for SegmentReply {}

/// The actor.
pub struct SegmentActor {
    /// The rasteriser.
    pub engine: Arc<dyn Engine>,
    /// How it projects.
    pub options: ProjectOptions,
    /// The scene.
    pub splats: Arc<Splats>,
    /// The photos' cameras at working size; those that a selection may be carried to.
    pub views: Arc<Vec<PosedView>>,
    /// Which views a selection may not be carried to, such as photos that were skipped.
    pub barred: Arc<Vec<bool>>,
    /// The feature field, if there is one.
    pub features: Option<Arc<SplatFeatures>>,
    /// Reads photos.
    pub photos: Arc<PhotoReader>,
    /// Reads the photos' skies.
    pub skies: Arc<MaskReader>,
    /// Reads the photos' transient masks.
    pub transients: Arc<MaskReader>,
    /// Turns prompts into masks.
    pub segmenter: Arc<dyn PromptSegmenter>,
    /// The scene tree, if there is one.
    pub tree: Option<Arc<SceneTree>>,
    /// Which splats one photo alone shows, if the scene tree knows it; one flag per splat.
    pub seen_once: Option<Vec<bool>>,
    /// The neighbour graph with its affinities, made at the first task, and again where a task's setting needs another.
    pub graph: SceneGraph,
    /// Which splats each view shows, as far as tasks needed it; `None` where that takes too much memory.
    pub shown: Option<ViewSplats>,
    /// Views of which that is computed while there is no task, one after the other.
    pub ahead: Range<usize>,
    /// About how many bytes of memory it keeps from task to task beside what it shares: [`SegmentActor::count_bytes`] sets it.
    pub bytes: Arc<AtomicUsize>,
}

/// Why a group of the scene tree selects nothing.
const NOWHERE: &str = "the object does not show in its photo";

/// Publishes the steps of a task's answer.
struct TaskSteps<'a> {
    task: &'a SegmentTask,
    context: &'a Context,
}

impl AnswerSteps for TaskSteps<'_> {
    fn publish(&self, step: AnswerStep, labels: Vec<bool>) {
        // The receiver is late: a later answer will do.
        let _ = self.task.reply.try_send(SegmentReply::Step(step, labels));
    }

    fn cancelled(&self) -> bool {
        self.task.cancel.phase() != Phase::Running || self.context.stopping()
    }
}

impl SegmentActor {
    /// Counts the memory of the neighbour graph, of its affinities and of what the views show, as far as they are made.
    pub fn count_bytes(&self) {
        let shown = self.shown.as_ref().map_or(0, ViewSplats::bytes);
        let seen_once = self.seen_once.as_ref().map_or(0, Vec::len);
        self.bytes.store(self.graph.bytes() + shown + seen_once, Ordering::Relaxed);
    }

    fn segment(&mut self, task: &SegmentTask, context: &Context) -> Result<Segmented, SegmentError> {
        let steps = TaskSteps { task, context };
        if steps.cancelled() {
            return Err(SegmentError::Cancelled);
        }
        let neighbours = task.settings.neighbours;
        // A setting that cannot be used is refused before it needs a graph.
        if (1..=MOST_NEIGHBOURS).contains(&neighbours) && !self.graph.fits(&self.splats, neighbours) {
            let _zone = context.busy_zone("neighbour graph");
            self.graph = SceneGraph::new(&self.splats, neighbours);
        }
        let provider = |view: usize, reason: String| SegmentError::Provider {
            photo: self.views.get(view).map_or_else(String::new, |v| v.name.clone()),
            reason,
        };
        let read =
            |(view, _): &(usize, Prompts)| (self.photos)(*view).map_err(|e| provider(*view, e.to_string()));
        let photos: Vec<Image> = task.prompts.iter().map(read).collect::<Result<_, _>>()?;
        let resident = self.engine.upload_splats(&self.splats).map_err(SegmentError::raster("the scene"))?;
        let hits = ClickHits::default();
        let blank = Request {
            rasterizer: resident.as_deref().unwrap_or(&*self.engine),
            backend: &*self.engine,
            options: self.options,
            splats: &self.splats,
            views: &self.views,
            prompts: &[],
            prior: None,
            features: self.features.as_deref(),
            hits: Some(&hits),
            graph: self.graph.graph(),
            affinities: Some(self.graph.affinities()),
            shown: self.shown.as_ref(),
            frozen: None,
            seen_once: self.seen_once.as_deref(),
            skies: Some(&*self.skies),
            transients: Some(&*self.transients),
            steps: Some(&steps),
            settings: &task.settings,
        };
        let TreeAnswer { group, alternatives, other } = match (&self.tree, &task.group) {
            (Some(tree), Some(meant)) => {
                let photos_of = tree_answer::OutlinedPhotos {
                    prompted: &task.prompts,
                    photos: &photos,
                    segmenter: &*self.segmenter,
                    answered: None,
                    own_masks: &[],
                };
                let leaves = CorrectedLeaves::uncorrected(tree.leaves_of(meant));
                let outlined = tree_answer::GroupAnswer::of(&blank, tree, &leaves, meant.score, &photos_of)?;
                let group = outlined.ok_or(SegmentError::NothingSelected { reason: NOWHERE })?;
                TreeAnswer { group: Some(group), ..TreeAnswer::default() }
            }
            (Some(tree), None) => {
                tree_answer::answer(&blank, tree, &task.prompts, &photos, &*self.segmenter)?
            }
            (None, _) => TreeAnswer::default(),
        };
        let mask_of = |((view, prompts), image): (&(usize, Prompts), &Image)| {
            // Where all clicks are negative, they are turned into positive ones: the mask is that of the thing that is refused.
            let refused = refuses(prompts);
            let mut positive = prompts.clone();
            positive.points.iter_mut().for_each(|p| p.inside |= refused);
            self.segmenter.prompted(image, &positive).map_err(|e| provider(*view, e.to_string()))
        };
        let own: Vec<Prompted> = match &group {
            Some(_) => Vec::new(),
            None => task.prompts.iter().zip(&photos).map(mask_of).collect::<Result<_, _>>()?,
        };
        let prompted: Vec<PromptedView> = match &group {
            // What the clicks refuse is outside of the group already.
            Some(group) => task
                .prompts
                .iter()
                .zip(&group.masks)
                .filter_map(|((view, prompts), mask)| {
                    let mask = &mask.as_ref()?.mask;
                    let Prompts { points, boxes, .. } = prompts;
                    Some(PromptedView { view: *view, mask, open: None, refused: false, points, boxes })
                })
                .collect(),
            None => task
                .prompts
                .iter()
                .zip(&own)
                .map(|((view, prompts), found)| PromptedView {
                    view: *view,
                    mask: &found.answer.mask,
                    open: Some(&found.open),
                    refused: refuses(prompts),
                    points: &prompts.points,
                    boxes: &prompts.boxes,
                })
                .collect(),
        };
        let prior = group.as_ref().map(|group| &group.prior);
        let expected_iou = group.as_ref().map(|group| group.expected_iou);
        let request = Request { prompts: &prompted, prior, ..blank };
        let refiner = PhotoRefiner { actor: self, context, prepared: Mutex::default() };
        let mut selection = select(&request, Some(&refiner))?;
        let cut = cut(&request, &selection)?;
        // Nothing else reads what each view sees, and answers are kept.
        selection.visits.iter_mut().for_each(|visit| visit.visibility = Vec::new());
        // The object is complete. The receiver may be late: the last answer has it as well.
        let _ = task.reply.try_send(SegmentReply::Selected(selection.labels.clone(), cut.clone()));
        let masks = match group {
            Some(group) => group.masks,
            None => own.into_iter().map(|found| Some(found.answer)).collect(),
        };
        let meant = task.prompts.iter().zip(masks).filter(|((_, prompts), _)| !refuses(prompts));
        let masks: Vec<(usize, ScoredMask)> =
            meant.filter_map(|((view, _), mask)| Some((*view, mask?))).collect();
        let photos = measure(&blank, &selection, &cut, &masks)?;
        let iou_with =
            |(tree, other): (&Arc<SceneTree>, Vec<bool>)| tree.light_iou(&selection.labels, &other);
        let levels_agreement = self.tree.as_ref().zip(other).map(iou_with);
        let opinion = TreeOpinion { expected_iou, levels_agreement };
        let confidence = SelectionConfidence::of(&photos, opinion, task.settings.propagate_gate);
        Ok(Segmented { selection, cut, masks, expected_iou, alternatives, confidence })
    }
}

impl SegmentActor {
    /// Finds what one view shows before a task needs it, on one thread: whoever opens a scene looks at it meanwhile.
    fn find_shown(&self, view: usize) -> Result<(), String> {
        let (Some(shown), Some(posed)) = (&self.shown, self.views.get(view)) else { return Ok(()) };
        let (engine, splats, options) = (&*self.engine, &*self.splats, &self.options);
        let found = || SplatSet::in_view(engine, splats, options, &posed.camera, &posed.pose);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().map_err(|e| e.to_string())?;
        let found = pool.install(|| shown.of(view, found));
        found.map(drop).map_err(|e| e.to_string())
    }
}

/// Refines masks on the photos that a selection is carried to.
struct PhotoRefiner<'a> {
    actor: &'a SegmentActor,
    context: &'a Context,
    /// Photos that were read before their turn.
    prepared: Mutex<HashMap<usize, Image>>,
}

impl PhotoRefiner<'_> {
    fn read(&self, view: usize) -> Option<Image> {
        if self.answers(view) { (self.actor.photos)(view).ok() } else { None }
    }

    fn prepared(&self) -> MutexGuard<'_, HashMap<usize, Image>> {
        lock(&self.prepared)
    }
}

impl Refiner for PhotoRefiner<'_> {
    fn refine(&self, view: usize, certainty: &Image) -> Option<(Mask, f32)> {
        self.context.progress();
        let read = self.prepared().remove(&view);
        let photo = read.or_else(|| self.read(view))?;
        let wide = certainty.resized(photo.width, photo.height);
        let refined = self.actor.segmenter.refined_mask(&photo, &wide);
        // A photo in which the model finds nothing is an answer; a model that fails is none.
        if let Err(error) = &refined
            && !matches!(error, VisionError::Image(_))
        {
            tracing::warn!("view {view} takes no part in an answer: {error}");
        }
        let (mask, predicted_iou) = refined.ok()?;
        Some((mask, predicted_iou.clamp(0.0, 1.0)))
    }

    fn answers(&self, view: usize) -> bool {
        !self.actor.barred.get(view).copied().unwrap_or(true)
    }

    fn prepare(&self, view: usize) {
        if let Some(photo) = self.read(view) {
            self.actor.segmenter.prepare(&photo);
            self.prepared().insert(view, photo);
        }
    }

    fn forget(&self, view: usize) {
        self.prepared().remove(&view);
    }
}

impl Actor for SegmentActor {
    type Message = SegmentTask;

    /// Prepares the first task, a little at a time: a task that comes meanwhile waits for the affinities of the graph, or
    /// for one view.
    fn on_idle(&mut self, context: &Context) -> Result<Idle, ActorFailure> {
        context.progress();
        if self.graph.compare(&self.splats, self.features.as_deref()) {
            self.count_bytes();
            return Ok(Idle::Again);
        }
        let Some(view) = self.ahead.next() else { return Ok(Idle::Wait) };
        if let Err(reason) = self.find_shown(view) {
            // A task computes it again, and reports what fails.
            tracing::debug!(view, %reason, "what a view shows is not known before the first click");
            self.ahead = 0..0;
        }
        self.count_bytes();
        Ok(Idle::Again)
    }

    fn handle(&mut self, task: SegmentTask, context: &Context) -> Result<(), ActorFailure> {
        let answer = self.segment(&task, context).map(Box::new);
        self.count_bytes();
        // Nobody may be waiting for the answer any more.
        let _ = task.reply.blocking_send(SegmentReply::Done(answer));
        Ok(())
    }
}
