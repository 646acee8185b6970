//! The first answer to clicks by the scene tree (method, section 13).

use crate::scene_tree::{GroupCandidate, NONE, SCENE_AREA, SceneTree, TreeQuery};
use crate::select::hits;
use crate::{AnswerStep, Evidence, FirstAnswer, PosedView, PromptedView, Request, SegmentError, seen_once};
use segwild_raster::Channels;
use segwild_scene::{Image, Mask, Prompts, ScoredMask};
use segwild_vision::{PromptSegmenter, VisionError};

/// Votes and coverage evidence of the scene tree on each splat (method, section 13): those of so many photos that see it whole.
/// One photo's, for the tree is one opinion. Half and half more changed no measured click.
const TREE_VOTE: f32 = 1.0;

/// Share of some pixel that a group must make up to show in a photo. By choice. Half and half more changed no measured click.
const MIN_GROUP_SHARE: f32 = 0.5;

/// Something that clicks may select.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Alternative {
    /// A group of the scene tree: its share of the light that all photos see.
    Group(f32),
    /// What the clicked photo's own mask holds.
    Photo,
}

/// What clicks select.
#[derive(Default)]
pub(crate) struct TreeAnswer {
    /// The group that is selected; `None` where the photos' own masks are.
    pub group: Option<GroupAnswer>,
    /// What the clicks may select, in the order of [`SegmentSettings::alternative`](crate::SegmentSettings::alternative).
    pub alternatives: Vec<Alternative>,
}

/// A group of the scene tree as an answer.
pub(crate) struct GroupAnswer {
    /// What it says of each splat.
    pub prior: Evidence,
    /// Its expected IoU with what the clicks mean, in [0, 1].
    pub expected_iou: f32,
    /// Per prompted photo, its outline there by the photo's own boundaries; `None` where it does not show.
    pub masks: Vec<Option<ScoredMask>>,
}

/// Whether all prompts are clicks.
fn only_clicks(prompts: &Prompts) -> bool {
    prompts.boxes.is_empty() && !prompts.points.is_empty()
}

/// The tree's answer to clicks, with their photos. The photo's own mask comes first where a photo has several positive clicks,
/// since it was drawn through all of them (on `liberty`, two clicks in one photo: IoU .94 to .96, by the tree .88), and where the
/// tree answers with most of the scene. `request` needs no prompts.
pub(crate) fn answer(
    request: &Request,
    tree: &SceneTree,
    clicks: &[(usize, Prompts)],
    photos: &[Image],
    segmenter: &dyn PromptSegmenter,
) -> Result<TreeAnswer, SegmentError> {
    let settings = request.settings;
    if settings.first_answer != FirstAnswer::Tree
        || tree.leaf.len() != request.splats.len()
        || !clicks.iter().all(|(_, prompts)| only_clicks(prompts))
    {
        return Ok(TreeAnswer::default());
    }
    let nothing = Mask::empty(1, 1);
    let points: Vec<PromptedView> = clicks
        .iter()
        .map(|(view, prompts)| PromptedView {
            view: *view,
            mask: &nothing,
            open: None,
            refused: false,
            points: &prompts.points,
            boxes: &[],
        })
        .collect();
    let (positive, negative) = hits(&Request { prompts: &points, ..*request })?;
    let Some(inside) = positive.iter().map(|hit| tree.leaf_of(hit)).collect::<Option<Vec<u32>>>() else {
        return Ok(TreeAnswer::default());
    };
    let outside: Vec<u32> = negative.iter().filter_map(|hit| tree.leaf_of(hit)).collect();
    let query = TreeQuery { inside: &inside, outside: &outside };
    let granularity = clicks.iter().find_map(|(_, prompts)| prompts.granularity);
    let found = match granularity {
        Some(granularity) => tree.candidates_of_size(&query, granularity),
        None => tree.candidates(&query),
    };
    let Some(first) = found.first() else { return Ok(TreeAnswer::default()) };
    let mut candidates: Vec<Option<&GroupCandidate>> = found.iter().map(Some).collect();
    let several = |(_, prompts): &(usize, Prompts)| prompts.points.iter().filter(|p| p.inside).count() > 1;
    let by_photo = granularity.is_none() && (clicks.iter().any(several) || first.area > SCENE_AREA);
    candidates.insert(usize::from(!by_photo), None);
    let named = |candidate: &Option<&GroupCandidate>| match candidate {
        Some(candidate) => Alternative::Group(candidate.area),
        None => Alternative::Photo,
    };
    let alternatives = candidates.iter().map(named).collect();
    let last = candidates.len() - 1;
    let Some(chosen) = candidates[last.min(settings.alternative as usize)] else {
        return Ok(TreeAnswer { group: None, alternatives });
    };
    let group = GroupAnswer::of(request, tree, chosen, clicks, photos, segmenter)?;
    Ok(TreeAnswer { group, alternatives })
}

impl GroupAnswer {
    /// A group as an answer; `None` where it shows in no photo whose prompts mean it: it cannot be refined there.
    pub fn of(
        request: &Request,
        tree: &SceneTree,
        chosen: &GroupCandidate,
        prompts: &[(usize, Prompts)],
        photos: &[Image],
        segmenter: &dyn PromptSegmenter,
    ) -> Result<Option<GroupAnswer>, SegmentError> {
        let labels = tree.labels(chosen);
        request.wanted()?;
        if let Some(steps) = request.steps {
            let mut shown = labels.clone();
            if let Some(once) = request.seen_once {
                seen_once::leave_out(&mut shown, once);
            }
            steps.publish(AnswerStep::Tree, shown);
        }
        let mut prior = Evidence::none(labels.len());
        for (i, &label) in labels.iter().enumerate().filter(|(i, _)| tree.leaf[*i] != NONE) {
            let side = if label { &mut prior.inside } else { &mut prior.outside };
            side[i] = TREE_VOTE;
            prior.known[i] = TREE_VOTE;
        }
        let mut masks = Vec::with_capacity(prompts.len());
        for ((view, _), photo) in prompts.iter().zip(photos) {
            let posed = &request.views[*view];
            let share = share_of(request, posed, &labels)?;
            let wide = share.resized(photo.width, photo.height);
            let failed =
                |e: VisionError| SegmentError::Provider { photo: posed.name.clone(), reason: e.to_string() };
            let refined = match wide.data.iter().any(|&share| share > MIN_GROUP_SHARE) {
                true => Some(segmenter.refine(photo, &wide).map_err(failed)?),
                false => None,
            };
            masks.push(refined.filter(|refined| !refined.mask.is_empty()));
        }
        let means = |p: &Prompts| p.points.is_empty() || p.points.iter().any(|p| p.inside);
        let shows = prompts.iter().zip(&masks).any(|((_, p), mask)| means(p) && mask.is_some());
        Ok(shows.then_some(GroupAnswer { prior, expected_iou: chosen.score.clamp(0.0, 1.0), masks }))
    }
}

/// The share of each pixel of a view that labelled splats make up.
fn share_of(request: &Request, view: &PosedView, labels: &[bool]) -> Result<Image, SegmentError> {
    let values: Vec<f32> = labels.iter().map(|&label| f32::from(u8::from(label))).collect();
    let raster = || SegmentError::raster(&view.name);
    let projected = request
        .rasterizer
        .project(request.splats, &view.camera, &view.pose, &request.options)
        .map_err(raster())?;
    Ok(projected.blend(&Channels { count: 1, values: &values }).map_err(raster())?.image)
}
