//! The first answer to prompts by the scene tree (method, section 13).

use crate::box_bounds::within_box;
use crate::scene_tree::{
    BoxedGroups, BoxedLeaves, CorrectedLeaves, GroupCandidate, LeafClick, LeafMap, NONE, SCENE_AREA,
    SURFACE_IOU, SceneSurface, SceneTree, ShownLeaves,
};
use crate::select::hits;
use crate::{
    AnswerStep, Evidence, FirstAnswer, PosedView, PromptedView, Request, SegmentError, TreeBoundaries,
    seen_once,
};
use glam::Vec2;
use segwild_raster::{Channels, CpuEngine};
use segwild_scene::{Image, Mask, Prompts, ScoredMask};
use segwild_vision::{PromptSegmenter, VisionError};

/// Votes and coverage evidence of the scene tree on each splat (method, section 13): those of so many photos that see it whole.
/// One photo's, for the tree is one opinion. Half and half more changed no measured click.
const TREE_VOTE: f32 = 1.0;

/// The same on the splats of a part that a click added or took out: so many photos do not outvote a person.
const CORRECTION_VOTE: f32 = 16.0;

/// IoU of a group with the own mask of a photo with a box or several positive clicks from which both mean the same. By choice.
const MIN_AGREEMENT: f64 = 0.5;

/// Something that prompts may select.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Alternative {
    /// A group of the scene tree: its share of the light that all photos see.
    Group(f32),
    /// The surface that the click is on, without what stands there: its share of the light that all photos see.
    Surface(f32),
    /// What the prompted photo's own mask holds.
    Photo,
}

/// The same, as the tree has it.
#[derive(Clone, Copy)]
enum Candidate<'a> {
    Group(&'a GroupCandidate),
    Surface(&'a SceneSurface),
    Photo,
}

impl Candidate<'_> {
    /// Its leaves, and its expected IoU; `None` for the photo's own mask.
    fn leaves(self, tree: &SceneTree) -> Option<(Vec<bool>, f32)> {
        match self {
            Candidate::Group(group) => Some((tree.leaves_of(group), group.score)),
            Candidate::Surface(surface) => Some((tree.leaves_on(surface), SURFACE_IOU)),
            Candidate::Photo => None,
        }
    }
}

/// What prompts select.
#[derive(Default)]
pub(crate) struct TreeAnswer {
    /// The group that is selected; `None` where the photos' own masks are.
    pub group: Option<GroupAnswer>,
    /// What the prompts may select, in the order of [`SegmentSettings::alternative`](crate::SegmentSettings::alternative).
    pub alternatives: Vec<Alternative>,
    /// Whether each leaf belongs to the likeliest group or surface that is not selected; `None` where there is none.
    pub other: Option<Vec<bool>>,
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

/// Photos in which a group of the scene tree is outlined.
pub(crate) struct OutlinedPhotos<'a> {
    /// Views with their prompts.
    pub prompted: &'a [(usize, Prompts)],
    /// Their photos.
    pub photos: &'a [Image],
    /// Draws the outlines.
    pub segmenter: &'a dyn PromptSegmenter,
    /// The one whose own mask answered the first click, by number: that mask is kept where it agrees with the group.
    pub answered: Option<usize>,
    /// Their own masks, as far as they are known and to be kept where they agree with the group; may be shorter.
    pub own_masks: &'a [Option<ScoredMask>],
}

/// Whether all prompts are negative clicks.
pub(crate) fn refuses(prompts: &Prompts) -> bool {
    !prompts.points.is_empty() && !prompts.say_where()
}

/// Whether a photo has several positive clicks.
fn several_inside(prompts: &Prompts) -> bool {
    prompts.points.iter().filter(|point| point.inside).count() > 1
}

/// The tree's answer to prompts, with their photos; `request` needs none. Boxes are answered by themselves. Of clicks the first
/// positive one chooses a group, and the others correct it. It chooses the surface that it is on where the likeliest group is cut
/// off by the photos' frames as a surface is, or is a piece of it. The photo's own mask comes first where several clicks are all
/// positive and in one photo, not all on that surface, and where the tree answers one click with the scene; always where the model
/// of the masks finds whole objects by itself.
pub(crate) fn answer(
    request: &Request,
    tree: &SceneTree,
    clicks: &[(usize, Prompts)],
    photos: &[Image],
    segmenter: &dyn PromptSegmenter,
) -> Result<TreeAnswer, SegmentError> {
    let settings = request.settings;
    if settings.first_answer != FirstAnswer::Tree || tree.leaf.len() != request.splats.len() {
        return Ok(TreeAnswer::default());
    }
    if clicks.iter().any(|(_, prompts)| !prompts.boxes.is_empty()) {
        return answer_to_boxes(request, tree, clicks, photos, segmenter);
    }
    let Some(mut hit) = leaf_clicks(request, tree, clicks)? else { return Ok(TreeAnswer::default()) };
    let Some(at) = hit.iter().position(|(_, click)| click.inside) else { return Ok(TreeAnswer::default()) };
    let (prompt, start) = hit.remove(at);
    let mut corrections: Vec<LeafClick> = hit.into_iter().map(|(_, click)| click).collect();
    let granularity = clicks.iter().find_map(|(_, prompts)| prompts.granularity);
    let boundaries = settings.tree_boundaries;
    let mut found = match granularity {
        Some(granularity) => tree.candidates_of_size(start.leaf, granularity, boundaries),
        None => tree.candidates(start.leaf, boundaries),
    };
    let is_scene = granularity.is_none() && found.first().is_some_and(|first| first.area > SCENE_AREA);
    // Drawn through all clicks (on `liberty`, two clicks in one photo: IoU .96, by the tree .90).
    let together = match clicks {
        [(_, prompts)] => {
            granularity.is_none() && several_inside(prompts) && corrections.iter().all(|c| c.inside)
        }
        _ => false,
    };
    // A surface is a matter of geometry, and has no size to choose.
    let has_surfaces =
        granularity.is_none() && boundaries != TreeBoundaries::Photo && !segmenter.finds_objects();
    if !has_surfaces {
        corrections.iter_mut().for_each(|click| click.surface = None);
    }
    let surface = start.surface.filter(|_| has_surfaces);
    let all_on_it = corrections.iter().all(|click| click.surface == start.surface);
    let may_be_thing = found
        .first()
        .zip(surface)
        .is_some_and(|(first, surface)| tree.is_thing_on(first, &tree.surfaces[surface]));
    let on_surface = surface.is_some() && (all_on_it || !together) && !may_be_thing;
    if is_scene && !corrections.is_empty() && !on_surface {
        // The click alone was answered by its photo: what is corrected is the group most like that.
        let (view, prompts) = &clicks[prompt];
        let alone = prompts.points.iter().copied().find(|point| point.inside);
        let alone = (*view, Prompts { points: alone.into_iter().collect(), ..Prompts::default() });
        let own = own_mask(request, &alone, &photos[prompt], segmenter)?;
        found.splice(0..0, tree.most_alike(&start, &own.mask, boundaries));
    }
    if found.is_empty() && surface.is_none() {
        return Ok(TreeAnswer::default());
    }
    // On a surface a further click leaves the numbers of the others as they are.
    let by_photo = segmenter.finds_objects()
        || !on_surface && together
        || is_scene && (corrections.is_empty() || on_surface);
    let mut candidates: Vec<Candidate> = found.iter().map(Candidate::Group).collect();
    // Where the scene is first, groups keep their numbers when a further click puts the corrected one before them.
    let photo_at = if by_photo {
        0
    } else if is_scene {
        candidates.len()
    } else {
        1
    };
    candidates.insert(photo_at.min(candidates.len()), Candidate::Photo);
    if let Some(surface) = surface {
        candidates.insert(usize::from(!on_surface), Candidate::Surface(&tree.surfaces[surface]));
    }
    let answered = (is_scene && !on_surface).then_some(prompt);
    let outlined = OutlinedPhotos { prompted: clicks, photos, segmenter, answered, own_masks: &[] };
    answer_by(request, tree, &candidates, (Some(&start), &corrections), &outlined)
}

/// The tree's answer to boxes, with their photos: the group that they are drawn around, corrected by the clicks. The photos' own
/// masks come first where no group fits all boxes, and where the model of the masks finds whole objects by itself.
fn answer_to_boxes(
    request: &Request,
    tree: &SceneTree,
    prompted: &[(usize, Prompts)],
    photos: &[Image],
    segmenter: &dyn PromptSegmenter,
) -> Result<TreeAnswer, SegmentError> {
    // Several boxes in a photo are several things, or parts of one: the photo's own mask holds all of them.
    if prompted.iter().any(|(_, prompts)| prompts.boxes.len() > 1) {
        return Ok(TreeAnswer::default());
    }
    let Some(hit) = leaf_clicks(request, tree, prompted)? else { return Ok(TreeAnswer::default()) };
    let (engine, leaves) = (CpuEngine::new(), tree.leaf_count());
    let (mut boxes, mut own_masks) = (Vec::new(), vec![None; prompted.len()]);
    for (number, ((view, prompts), photo)) in prompted.iter().zip(photos).enumerate() {
        let Some(prompt) = prompts.boxes.first() else { continue };
        request.wanted()?;
        let posed = &request.views[*view];
        let map = LeafMap::render(&engine, request.splats, &request.options, posed, tree)
            .map_err(SegmentError::raster(&posed.name))?;
        // Clicks correct the group that the box alone means.
        let alone = (*view, Prompts { boxes: prompts.boxes.clone(), ..Prompts::default() });
        let own = own_mask(request, &alone, photo, segmenter)?;
        boxes.extend(BoxedLeaves::of(&map, leaves, prompt, &own.mask));
        if hit.iter().all(|(photo, _)| *photo == number) {
            let corrected = (!prompts.points.is_empty())
                .then(|| own_mask(request, &prompted[number], photo, segmenter))
                .transpose()?;
            own_masks[number] = Some(corrected.unwrap_or(own));
        }
    }
    let mut corrections: Vec<LeafClick> = hit.into_iter().map(|(_, click)| click).collect();
    if request.settings.tree_boundaries == TreeBoundaries::Photo || segmenter.finds_objects() {
        corrections.iter_mut().for_each(|click| click.surface = None);
    }
    let BoxedGroups { groups, fits } = match boxes.as_slice() {
        [] => BoxedGroups { groups: Vec::new(), fits: false },
        boxes => tree.groups_in_boxes(boxes, request.settings.tree_boundaries),
    };
    let mut candidates: Vec<Candidate> = groups.iter().map(Candidate::Group).collect();
    let photo_at = usize::from(fits && !segmenter.finds_objects());
    candidates.insert(photo_at, Candidate::Photo);
    let outlined = OutlinedPhotos { prompted, photos, segmenter, answered: None, own_masks: &own_masks };
    let answer = answer_by(request, tree, &candidates, (None, &corrections), &outlined)?;
    // A group that does not fit the box is no other opinion of it.
    Ok(if fits { answer } else { TreeAnswer { other: None, ..answer } })
}

/// The answer by the candidate that the settings choose, corrected by clicks. `first`: the click that chose the candidates.
fn answer_by(
    request: &Request,
    tree: &SceneTree,
    candidates: &[Candidate],
    (first, corrections): (Option<&LeafClick>, &[LeafClick]),
    outlined: &OutlinedPhotos,
) -> Result<TreeAnswer, SegmentError> {
    let named = |candidate: &Candidate| match candidate {
        Candidate::Group(group) => Alternative::Group(group.area),
        Candidate::Surface(surface) => Alternative::Surface(surface.area),
        Candidate::Photo => Alternative::Photo,
    };
    let alternatives = candidates.iter().map(named).collect();
    let chosen_at = (candidates.len() - 1).min(request.settings.alternative as usize);
    let mut others = candidates.iter().enumerate().filter(|(at, _)| *at != chosen_at);
    let corrected = |leaves| tree.corrected(leaves, first, corrections);
    let other =
        others.find_map(|(_, other)| other.leaves(tree)).map(|(leaves, _)| corrected(leaves).selected);
    let Some((leaves, expected_iou)) = candidates[chosen_at].leaves(tree) else {
        return Ok(TreeAnswer { group: None, alternatives, other });
    };
    let group = GroupAnswer::of(request, tree, &corrected(leaves), expected_iou, outlined)?;
    Ok(TreeAnswer { group, alternatives, other })
}

/// The leaves that clicks hit, in order, each with the number of its photo's prompts; `None` where a positive one hits none. A
/// negative one that hits none says nothing.
fn leaf_clicks(
    request: &Request,
    tree: &SceneTree,
    clicks: &[(usize, Prompts)],
) -> Result<Option<Vec<(usize, LeafClick)>>, SegmentError> {
    let (nothing, engine) = (Mask::empty(1, 1), CpuEngine::new());
    // One click alone corrects nothing.
    let several =
        clicks.iter().map(|(_, prompts)| prompts.points.len() + prompts.boxes.len()).sum::<usize>() > 1;
    let mut found = Vec::new();
    for (number, (view, prompts)) in clicks.iter().enumerate() {
        for point in &prompts.points {
            request.wanted()?;
            let points = std::slice::from_ref(point);
            let prompt =
                PromptedView { view: *view, mask: &nothing, open: None, refused: false, points, boxes: &[] };
            let (positive, negative) = hits(&Request { prompts: &[prompt], ..*request })?;
            let hit = positive.first().or(negative.first());
            match hit.and_then(|hit| Some((tree.leaf_of(hit)?, tree.surface_at(hit)))) {
                Some((leaf, surface)) => {
                    let (posed, at) = (&request.views[*view], Vec2::new(point.x, point.y));
                    let (splats, options) = (request.splats, &request.options);
                    let shown = || ShownLeaves::of(&engine, tree, splats, options, posed, at);
                    let shown = several.then(shown).transpose().map_err(SegmentError::raster(&posed.name))?;
                    found.push((number, LeafClick { leaf, surface, inside: point.inside, shown }));
                }
                None if point.inside => return Ok(None),
                None => {}
            }
        }
    }
    Ok(Some(found))
}

/// The mask that a photo itself gives for its prompts.
fn own_mask(
    request: &Request,
    (view, prompts): &(usize, Prompts),
    photo: &Image,
    segmenter: &dyn PromptSegmenter,
) -> Result<ScoredMask, SegmentError> {
    let name = || request.views[*view].name.clone();
    let failed = |e: VisionError| SegmentError::Provider { photo: name(), reason: e.to_string() };
    Ok(segmenter.prompted(photo, prompts).map_err(failed)?.answer)
}

impl GroupAnswer {
    /// A group, as clicks corrected it, as an answer with its expected IoU; `None` where it shows in no photo whose prompts mean
    /// it: it cannot be refined there.
    pub fn of(
        request: &Request,
        tree: &SceneTree,
        chosen: &CorrectedLeaves,
        expected_iou: f32,
        outlined: &OutlinedPhotos,
    ) -> Result<Option<GroupAnswer>, SegmentError> {
        let OutlinedPhotos { prompted: prompts, photos, segmenter, answered, own_masks } = *outlined;
        let labels = tree.splats_of(&chosen.selected);
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
            let vote = if chosen.decided[tree.leaf[i] as usize] { CORRECTION_VOTE } else { TREE_VOTE };
            side[i] = vote;
            prior.known[i] = vote;
        }
        let mut masks = Vec::with_capacity(prompts.len());
        for (at, (prompt, photo)) in prompts.iter().zip(photos).enumerate() {
            let posed = &request.views[prompt.0];
            let share = share_of(request, posed, &labels)?;
            let wide = share.resized(photo.width, photo.height);
            let failed =
                |e: VisionError| SegmentError::Provider { photo: posed.name.clone(), reason: e.to_string() };
            let refined = match wide.data.iter().any(|&share| share > 0.0) {
                true => Some(segmenter.refine(photo, &wide).map_err(failed)?),
                false => None,
            };
            // Where there are prompts, their photo answers for a group in which the model finds nothing.
            let alone = prompt.1.points.is_empty() && prompt.1.boxes.is_empty();
            let usable =
                |found: ScoredMask| if alone && found.mask.is_empty() { unrefined(&wide) } else { found };
            let shown = refined.map(usable).filter(|shown| !shown.mask.is_empty());
            // A mask that was drawn through several clicks or a box knows the outline better, too, if it means the same.
            let own = match own_masks.get(at) {
                Some(Some(own)) => Some(own.clone()),
                _ if shown.is_some() && (answered == Some(at) || several_inside(&prompt.1)) => {
                    Some(own_mask(request, prompt, photo, segmenter)?)
                }
                _ => None,
            };
            let means_same =
                |shown: &ScoredMask, own: &ScoredMask| own.mask.iou(&shown.mask) >= MIN_AGREEMENT;
            let within = |shown: ScoredMask| ScoredMask {
                mask: within_box(&shown.mask, &prompt.1, &posed.camera),
                ..shown
            };
            let shown = shown.map(within).filter(|shown| !shown.mask.is_empty());
            let own = own.map(within);
            masks.push(shown.map(|shown| own.filter(|own| means_same(&shown, own)).unwrap_or(shown)));
        }
        let shows = prompts.iter().zip(&masks).any(|((_, p), mask)| !refuses(p) && mask.is_some());
        Ok(shows.then_some(GroupAnswer { prior, expected_iou: expected_iou.clamp(0.0, 1.0), masks }))
    }
}

/// The mask of a group in which a model finds nothing, such as a small one: the pixels that it makes up half as much of as any.
fn unrefined(share: &Image) -> ScoredMask {
    let most = share.data.iter().copied().fold(0.0, f32::max);
    let least = (0.5 * most).max(f32::MIN_POSITIVE);
    let mask = Mask::from_fn(share.width as u32, share.height as u32, |x, y| {
        share.at(0, x as usize, y as usize) >= least
    });
    ScoredMask { mask, predicted_iou: most.clamp(0.0, 1.0), stability: 0.0 }
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
