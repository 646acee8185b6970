//! What a selection is made from: the scene, the photos and the prompts.

use crate::steps::AnswerSteps;
use crate::{
    ClickHits, Evidence, NeighbourGraph, SceneAffinities, SegmentError, SegmentSettings, SplatFeatures,
    ViewSplats,
};
use rayon::prelude::*;
use segwild_objective::FieldBackend;
use segwild_raster::{ProjectOptions, Projected, Rasterizer};
use segwild_scene::{BoxPrompt, Camera, Image, Mask, PointPrompt, Pose, Splats, View};

/// Views that several threads work on at once, at most: each takes memory.
pub(crate) const AT_ONCE: usize = 8;

/// Memory that their projections may take, and about what one takes per splat, in bytes.
const PROJECTED_BYTES: usize = 256 << 20;
const PROJECTED_SPLAT_BYTES: usize = 128;

/// A camera where it stood.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedView {
    /// The photo's name, for messages.
    pub name: String,
    /// Intrinsics at the size in which clicks are given.
    pub camera: Camera,
    /// World to camera.
    pub pose: Pose,
}

impl From<&View> for PosedView {
    fn from(view: &View) -> PosedView {
        PosedView { name: view.name.clone(), camera: view.camera, pose: view.pose }
    }
}

/// The prompts on one photo and their mask.
#[derive(Clone, Copy, Debug)]
pub struct PromptedView<'a> {
    /// Index into [`Request::views`].
    pub view: usize,
    /// The mask of the prompts, at any size that covers the photo edge to edge.
    pub mask: &'a Mask,
    /// How likely each pixel is part of the object although the mask leaves it out: one plane in [0, 1] over the photo edge
    /// to edge. `None` where the mask is certain.
    pub open: Option<&'a Image>,
    /// Whether the mask is of a refused thing: all prompts on this photo are negative. Such a mask holds no evidence about
    /// what lies outside it.
    pub refused: bool,
    /// The clicks, in pixels of the view's camera; may be empty (a box or a mask was the prompt).
    pub points: &'a [PointPrompt],
    /// The boxes, in the same pixels; may be empty.
    pub boxes: &'a [BoxPrompt],
}

/// Reads a mask of a view, its sky or its transients, at any size that covers the photo edge to edge; `None` where it is not
/// known.
pub type MaskReader = dyn Fn(usize) -> Option<Mask> + Send + Sync;

/// Everything a selection is made from.
#[derive(Clone, Copy)]
pub struct Request<'a> {
    /// The rasteriser.
    pub rasterizer: &'a dyn Rasterizer,
    /// Compares features on the device that has them.
    pub backend: &'a dyn FieldBackend,
    /// How it projects.
    pub options: ProjectOptions,
    /// The scene.
    pub splats: &'a Splats,
    /// The photos' cameras: the prompted ones, and those that a selection is carried to.
    pub views: &'a [PosedView],
    /// The prompted photos; at least one.
    pub prompts: &'a [PromptedView<'a>],
    /// What is known of the splats before any photo is queried, if the scene tree was.
    pub prior: Option<&'a Evidence>,
    /// One feature vector per splat, if there is a field.
    pub features: Option<&'a SplatFeatures>,
    /// What clicks of the same query hit, as far as it was rendered; rendered otherwise.
    pub hits: Option<&'a ClickHits>,
    /// The neighbour graph of the splats, if it is at hand; made otherwise.
    pub graph: Option<&'a NeighbourGraph>,
    /// The affinities of that graph, as far as earlier selections of the scene needed them; computed otherwise.
    pub affinities: Option<&'a SceneAffinities>,
    /// Which splats each view shows, as far as earlier selections of the scene needed it; computed otherwise.
    pub shown: Option<&'a ViewSplats>,
    /// Splats that can never be selected, such as the sky; one flag per splat.
    pub frozen: Option<&'a [bool]>,
    /// Which splats one photo alone shows, if that is known; one flag per splat.
    pub seen_once: Option<&'a [bool]>,
    /// Reads the skies of the views, if there are any.
    pub skies: Option<&'a MaskReader>,
    /// Reads the transient masks of the views, if there are any.
    pub transients: Option<&'a MaskReader>,
    /// Follows the selection while it is made, if somebody does.
    pub steps: Option<&'a dyn AnswerSteps>,
    /// The settings of this selection.
    pub settings: &'a SegmentSettings,
}

impl Request<'_> {
    /// The transient mask of a view; `None` where there is none.
    pub(crate) fn transients_in(&self, view: usize) -> Option<Mask> {
        self.transients.and_then(|read| read(view))
    }

    /// The neighbour graph of the splats: the one at hand, or one made into `built`.
    pub(crate) fn graph<'g>(&'g self, built: &'g mut Option<NeighbourGraph>) -> &'g NeighbourGraph {
        match self.graph {
            Some(graph) => graph,
            None => built.insert(NeighbourGraph::new(self.splats, self.settings.neighbours)),
        }
    }

    /// Views that may be projected at once, by several threads: one on a device, and where splats take too much memory.
    pub(crate) fn views_at_once(&self) -> usize {
        let fit = PROJECTED_BYTES / (PROJECTED_SPLAT_BYTES * self.splats.len().max(1));
        if self.rasterizer.is_on_host() { fit.clamp(1, AT_ONCE) } else { 1 }
    }

    /// Works on views that do not depend on each other, and returns what `work` gives for each, in order. The same whatever the
    /// number of threads.
    ///
    /// # Errors
    /// The first view's that fails, or once nobody waits for the selection any more.
    pub(crate) fn in_views<V: Sync, T: Send>(
        &self,
        views: &[V],
        work: impl Fn(&V) -> Result<T, SegmentError> + Sync,
    ) -> Result<Vec<T>, SegmentError> {
        let work = |view: &V| self.wanted().and_then(|()| work(view));
        let mut all = Vec::with_capacity(views.len());
        for some in views.chunks(self.views_at_once()) {
            let done: Vec<Result<T, SegmentError>> = match some {
                // Alone, a view has all threads.
                [view] => vec![work(view)],
                some => some.par_iter().with_max_len(1).map(&work).collect(),
            };
            for done in done {
                all.push(done?);
            }
        }
        Ok(all)
    }

    /// An error once nobody waits for the selection any more.
    pub(crate) fn wanted(&self) -> Result<(), SegmentError> {
        match self.steps.is_some_and(AnswerSteps::cancelled) {
            true => Err(SegmentError::Cancelled),
            false => Ok(()),
        }
    }
}

pub(crate) fn view<'a>(request: &Request<'a>, index: usize) -> Result<&'a PosedView, SegmentError> {
    request.views.get(index).ok_or(SegmentError::NoView { view: index, views: request.views.len() })
}

/// The camera at which a view's evidence is taken: the mask's size, or the photo's, but not over
/// [`SegmentSettings::evidence_size`].
pub(crate) fn working_camera(request: &Request, view: &PosedView, mask: Option<&Mask>) -> Camera {
    let camera = mask.map_or(view.camera, |m| view.camera.resized(m.width(), m.height()));
    match request.settings.evidence_size {
        0 => camera,
        size => camera.scaled_to(size),
    }
}

pub(crate) fn project<'a>(
    request: &Request<'a>,
    view: &PosedView,
    camera: &Camera,
) -> Result<Box<dyn Projected + 'a>, SegmentError> {
    request
        .rasterizer
        .project(request.splats, camera, &view.pose, &request.options)
        .map_err(SegmentError::raster(&view.name))
}
