//! The photos that a click may visit (method, section 6.9): all of a scene of few photos, and of one of many those that add most.

use crate::label_fusion::{FusionState, LabelFusion};
use crate::request::PosedView;
use crate::scene_tree::ENOUGH_VIEWS;
use crate::steps::PUBLISHED_AFTER;
use crate::view_splats::SplatSet;
use crate::{Refiner, Request, SegmentError, ViewSplats};
use glam::Vec3;
use rayon::prelude::*;
use segwild_scene::view_selection::{FramedView, ViewCoverage, cells_in_frame, select_rendered_views};
use std::collections::HashMap;
use std::sync::Arc;

/// Splats of the object for which photos are selected, at most (method, section 6.9). By choice: ten of them lie in a fiftieth of
/// the object. Not varied yet.
const SELECTION_POINTS: usize = 512;

/// Photos that are rendered to find what they show, per photo that may be visited, at most (method, section 6.9). By choice: of
/// the photos in whose frame a surface lies, half see it from its other side. Not varied yet.
const SURVEYED_PER_VISIT: usize = 2;

/// What a photo adds under which it is not visited, 1 being what the first photo adds that shows the whole object (method, section
/// 6.9). By choice: the eighth photo of the whole object from one direction adds less. Not varied yet.
const MIN_ADDED: f64 = 1.0 / 64.0;

/// The photos that a click has not visited yet and may visit.
pub(crate) struct OpenViews<'a> {
    request: &'a Request<'a>,
    refiner: &'a dyn Refiner,
    /// The views with no prompt that says what is meant.
    others: Vec<usize>,
    /// Visits at most.
    most: usize,
    /// Whether there are so many photos that some of them are selected.
    selects: bool,
    /// Visits at the last selection.
    selected_after: usize,
    /// The views that may be visited next, with the splats that they show.
    views: Vec<(usize, Arc<SplatSet>)>,
    /// The splats that prompted and visited views show, and those that are open: a bit per splat and view.
    known: HashMap<usize, Arc<SplatSet>>,
}

impl<'a> OpenViews<'a> {
    /// Those of a request, before any is visited.
    pub fn of(
        request: &'a Request<'a>,
        fusion: &LabelFusion,
        state: &FusionState,
        refiner: &'a dyn Refiner,
    ) -> Result<OpenViews<'a>, SegmentError> {
        let views = 0..request.views.len();
        let meant = |v: usize| request.prompts.iter().any(|p| !p.refused && p.view == v);
        let others: Vec<usize> = views.filter(|v| !meant(*v)).collect();
        let selects = others.len() > ENOUGH_VIEWS;
        let visits = request.settings.propagate_views;
        let most = if selects { visits.min(ENOUGH_VIEWS) } else { visits };
        let (views, known) = (Vec::new(), HashMap::new());
        let mut open = OpenViews { request, refiner, others, most, selects, selected_after: 0, views, known };
        match selects {
            true => open.select(fusion, state, &[])?,
            false => {
                let others = open.others.clone();
                open.compare(&others)?;
                for view in others {
                    let shown = open.shown_in(view)?;
                    open.views.push((view, shown));
                }
            }
        }
        Ok(open)
    }

    /// Visits at most, from the first on.
    pub fn most(&self) -> usize {
        self.most
    }

    /// The views that may be visited next, with the splats that they show.
    pub fn views(&self) -> &[(usize, Arc<SplatSet>)] {
        &self.views
    }

    /// Whether a view may be visited.
    pub fn contains(&self, view: usize) -> bool {
        self.views.iter().any(|(open, _)| *open == view)
    }

    /// Takes a view out: it is visited now.
    pub fn take(&mut self, view: usize) {
        self.views.retain(|(open, _)| *open != view);
    }

    /// Whether photos are to be selected again, because more of the object is known: after 8 visits and each doubling of them, and
    /// where none of those that were selected can be visited.
    pub fn is_due(&self, visits: usize, exhausted: bool) -> bool {
        let doubled = visits >= PUBLISHED_AFTER.max(2 * self.selected_after);
        self.selects && visits > self.selected_after && (exhausted || doubled)
    }

    /// Selects photos by what each adds to the prompted and visited ones for the splats that belong to the object so far.
    pub fn select(
        &mut self,
        fusion: &LabelFusion,
        state: &FusionState,
        visited: &[usize],
    ) -> Result<(), SegmentError> {
        self.selected_after = visited.len();
        let request = self.request;
        let views = request.views;
        let (splats, points) = object_points(request, &fusion.labels(state));
        let in_frame = |view: usize, shown: &dyn Fn(usize) -> bool| {
            cells_in_frame(&points, &views[view].camera, &views[view].pose, shown)
        };
        let left = self.most.saturating_sub(visited.len());
        let may_answer = |view: &usize| !visited.contains(view) && self.refiner.answers(*view);
        let candidates: Vec<usize> = self.others.iter().copied().filter(may_answer).collect();
        let meant = request.prompts.iter().filter(|prompt| !prompt.refused).map(|prompt| prompt.view);
        let queried: Vec<usize> = meant.chain(visited.iter().copied()).collect();
        let mut covered = ViewCoverage::none(points.len());
        self.compare(&queried)?;
        for &view in &queried {
            let shown = self.shown_in(view)?;
            covered.add(&in_frame(view, &|point| shown.contains(splats[point])));
        }
        // Frames take no rendering: a photo in whose frame a point lies may show it.
        let frames: Vec<Vec<u32>> = candidates.par_iter().map(|&view| in_frame(view, &|_| true)).collect();
        let centre = points.iter().sum::<Vec3>() / points.len().max(1) as f32;
        let photos: Vec<FramedView> = candidates
            .iter()
            .zip(&frames)
            .map(|(&view, cells)| {
                let PosedView { name, pose, .. } = &views[view];
                FramedView { name, cells, distance: (pose.centre() - centre).length() }
            })
            .collect();
        let mut surveyed = 0;
        let at_first = covered.clone();
        let render = |candidate: usize| -> Result<Vec<u32>, SegmentError> {
            request.wanted()?;
            surveyed += 1;
            let view = candidates[candidate];
            let shown = self.shown_in(view)?;
            let cells = in_frame(view, &|point| shown.contains(splats[point]));
            // No gain grows, so that this photo is not selected later.
            if at_first.gain(&cells) < MIN_ADDED {
                self.known.remove(&view);
            }
            Ok(cells)
        };
        let renders = SURVEYED_PER_VISIT * left;
        let selected = select_rendered_views(&photos, covered, left, MIN_ADDED, renders, render)?;
        let selected: Vec<usize> = selected.into_iter().map(|next| candidates[next.candidate]).collect();
        tracing::debug!(
            photos = self.others.len(),
            surveyed,
            selected = selected.len(),
            visited = visited.len(),
            "photos are selected for a click"
        );
        self.views.clear();
        for &view in &selected {
            let shown = self.shown_in(view)?;
            self.views.push((view, shown));
        }
        // Of the others the scene keeps what fits into its memory.
        self.known.retain(|view, _| queried.contains(view) || selected.contains(view));
        Ok(())
    }

    /// Finds what views show where that is not at hand: several at once, where they can be.
    fn compare(&mut self, views: &[usize]) -> Result<(), SegmentError> {
        let request = self.request;
        let missing: Vec<usize> =
            views.iter().copied().filter(|view| !self.known.contains_key(view)).collect();
        let shown = request.in_views(&missing, |&view| shown_in(request, view))?;
        self.known.extend(missing.into_iter().zip(shown));
        Ok(())
    }

    /// The splats that a view shows: those at hand, or computed.
    fn shown_in(&mut self, view: usize) -> Result<Arc<SplatSet>, SegmentError> {
        if let Some(known) = self.known.get(&view) {
            return Ok(known.clone());
        }
        let shown = shown_in(self.request, view)?;
        self.known.insert(view, shown.clone());
        Ok(shown)
    }
}

/// The splats that a view shows: those of the scene where they are known, or computed.
fn shown_in(request: &Request, index: usize) -> Result<Arc<SplatSet>, SegmentError> {
    let compute = || {
        let PosedView { name, camera, pose } = &request.views[index];
        SplatSet::in_view(request.rasterizer, request.splats, &request.options, camera, pose)
            .map_err(SegmentError::raster(name))
    };
    let of_scene = |shown: &&ViewSplats| shown.fits(request.splats.len(), request.views.len());
    match request.shown.filter(of_scene) {
        Some(shown) => shown.of(index, compute),
        None => Ok(Arc::new(compute()?)),
    }
}

/// Splats of an object, evenly by number, at most [`SELECTION_POINTS`] of them; and their centres.
fn object_points(request: &Request, labels: &[bool]) -> (Vec<usize>, Vec<Vec3>) {
    let centre = |splat: &usize| Vec3::from_array(request.splats.means[*splat]);
    let labelled = labels.iter().enumerate().filter(|(_, label)| **label).map(|(splat, _)| splat);
    let labelled: Vec<usize> = labelled.filter(|splat| centre(splat).is_finite()).collect();
    let count = labelled.len().min(SELECTION_POINTS);
    let splats: Vec<usize> = (0..count).map(|i| labelled[i * labelled.len() / count]).collect();
    let points = splats.iter().map(centre).collect();
    (splats, points)
}
