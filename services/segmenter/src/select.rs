//! Prompts to labels on splats (method, section 6).

use crate::box_bounds::BoxBounds;
use crate::coverage::visible;
use crate::feature_clusters::cluster_features;
use crate::graph::MOST_NEIGHBOURS;
use crate::label_fusion::{FusionState, LabelFusion, SPREAD_STEPS, Similarities};
use crate::photo_evidence::prompted_evidence;
use crate::request::{PromptedView, Request, project, view, working_camera};
use crate::settings::{ComponentRule, CutBy, SimilarityUse};
use crate::steps::AnswerStep;
use crate::{
    ClickHit, CutView, Evidence, MaskVote, NeighbourGraph, PhotoVisit, PosedView, Refiner, SegmentError,
    SpikeCut, SplatFeatures, components, propagate, seen_once, smooth,
};
use glam::Vec2;
use std::borrow::Cow;

/// Accumulated alpha `A` under which a click is on nothing (method, section 6): the error says so. By choice. Half and half
/// more changed no measured click.
const MIN_CLICK_ALPHA: f32 = 0.1;

/// IoU `d` of a selection with the prompted masks under which it has drifted to another object in the other photos (method,
/// section 6.4). Chosen on a click on the torch of `liberty` that came back as half a statue. Half and half more changed no
/// measured click.
const DRIFT_AGREEMENT: f32 = 0.25;

/// Factor by which the prompted photos alone must agree better with the prompts to replace a selection that has drifted. Half
/// and half more changed no measured click.
const DRIFT_GAIN: f32 = 2.0;

/// Share `rho_a` of its evidence that lies inside, from which an unselected splat is astride the outline (method, section 7).
/// By choice. IoU by half, half more: -.004, +.002 on `sacre_coeur`; +.004, -.005 on the demo.
const ASTRIDE_SHARE: f32 = 0.2;

/// Coverage evidence `K_a`, in views, from which that share is known (method, section 7). By choice. IoU by half, half more: 0,
/// 0 on `sacre_coeur`; +.001, 0 on the demo.
const ASTRIDE_COVERAGE: f32 = 0.2;

/// A selection.
#[derive(Clone, Debug, PartialEq)]
pub struct Selection {
    /// Whether each splat belongs to the object.
    pub labels: Vec<bool>,
    /// How likely each splat belongs to it, in [0, 1], before connected parts are taken away.
    pub score: Vec<f32>,
    /// Fused similarity to the positive clicks per splat, where features took part.
    pub similarity: Option<Vec<f32>>,
    /// The evidence of the masks.
    pub evidence: Evidence,
    /// The result of each photo that the selection was carried to, in the order of the last round.
    pub visits: Vec<PhotoVisit>,
    /// The splats that could not be selected: the request's, those that its boxes bar, and those that one photo alone shows, unless
    /// the object is seen once itself; `None` where there are none.
    pub frozen: Option<Vec<bool>>,
    /// Connected parts taken away.
    pub parts_removed: usize,
    /// Splats left out because one photo alone shows them.
    pub seen_once: usize,
    /// IoU of the selection with the prompted masks, in visible light of the prompted photos.
    pub agreement: f32,
    /// Whether only the prompted photos decide, because the selection drifted to another object in the others.
    pub alone: bool,
}

/// Selects the splats of the prompted object. With a `refiner`, the selection is carried to all other views and back
/// ([`crate::SegmentSettings::propagate`]).
pub fn select(request: &Request, refiner: Option<&dyn Refiner>) -> Result<Selection, SegmentError> {
    check(request)?;
    let (settings, splats) = (request.settings, request.splats);
    let (positive, negative) = hits(request)?;
    let BoxBounds { against, frozen } = BoxBounds::of(request, &positive)?;
    let request = &Request { frozen: frozen.as_deref(), ..*request };
    let mut prompted = Evidence::none(splats.len());
    for prompt in request.prompts {
        prompted.add(&prompted_evidence(request, prompt)?, settings.prompt_weight);
    }
    // The masks alone say how well an answer agrees with the prompts: what the scene tree says, and what a box leaves out, weigh
    // too much for that.
    let masks = prompted.clone();
    if let Some(prior) = request.prior {
        prompted.add(prior, 1.0);
    }
    prompted.add(&against, 1.0);
    let similarities = similarities(request, &prompted, &positive, &negative)?;
    // Where masks take no part, there is nothing to carry to other photos.
    let alone = settings.similarity_use == SimilarityUse::Alone;
    if alone && similarities.is_none() {
        return Err(SegmentError::NoFeatures);
    }
    let rounds = if alone { 0 } else { settings.propagate };
    let mut built = None;
    let graph = request.graph(&mut built);
    let features = request.features.filter(|_| settings.similarity_use != SimilarityUse::Off);
    let fusion = LabelFusion {
        splats,
        graph,
        hits: (&positive, &negative),
        affinities: match request.affinities {
            Some(known) => Cow::Borrowed(known.of(graph, splats, features)),
            None => Cow::Owned(graph.affinities(splats, features)),
        },
        similarities,
        frozen: request.frozen,
        settings,
    };
    // An earlier answer that cannot be given is no reason to stop.
    let publish = |step: AnswerStep, state: &FusionState| {
        if let Some(steps) = request.steps
            && let Ok(Labelled { mut labels, .. }) = labelled(request, &fusion, &prompted, state)
        {
            if let Some(once) = request.seen_once {
                seen_once::leave_out(&mut labels, once);
            }
            steps.publish(step, labels);
        }
    };
    let (state, visits) = match refiner {
        Some(refiner) if rounds > 0 => {
            propagate::propagate(request, &fusion, prompted.clone(), refiner, &publish)?
        }
        _ => (fusion.weigh(prompted.clone(), Vec::new(), SPREAD_STEPS), Vec::new()),
    };
    let decide = |state| decide(request, &fusion, (&prompted, &masks), state);
    let carried = decide(state);
    let elsewhere = carried.as_ref().map_or(true, |s| s.agreement < DRIFT_AGREEMENT && !visits.is_empty());
    if !elsewhere || rounds == 0 {
        return carried.map(|carried| Selection { visits, ..carried });
    }
    // The other photos hold evidence of another object: only the prompted photos decide.
    let own = decide(fusion.weigh(prompted.clone(), Vec::new(), SPREAD_STEPS));
    match (carried, own) {
        (Ok(carried), Ok(own)) if own.agreement < DRIFT_GAIN * carried.agreement => {
            Ok(Selection { visits, ..carried })
        }
        (_, Ok(own)) => {
            let visits = visits.into_iter().map(PhotoVisit::disregarded).collect();
            Ok(Selection { visits, alone: true, ..own })
        }
        (carried, Err(_)) => carried.map(|carried| Selection { visits, ..carried }),
    }
}

/// Labels, and how many connected parts were taken away.
struct Labelled {
    labels: Vec<bool>,
    parts_removed: usize,
}

/// From beliefs to labels.
fn labelled(
    request: &Request,
    fusion: &LabelFusion,
    prompted: &Evidence,
    state: &FusionState,
) -> Result<Labelled, SegmentError> {
    let (settings, splats, graph) = (request.settings, request.splats, fusion.graph);
    let mut labels = fusion.labels(state);
    none_left(&labels, "none lies in the masks and resembles the clicks")?;
    if settings.graph_cut {
        labels = smooth::graph_cut(graph, &fusion.affinities, &state.probability, request.frozen);
        none_left(&labels, "the graph cut smoothed all away: switch `graph_cut` off")?;
    }
    let mut parts_removed = 0;
    if settings.components == ComponentRule::Clicked {
        let share = settings.component_share;
        let (all, others) = (&state.evidence, state.evidence.minus(prompted));
        parts_removed =
            components::keep_clicked(graph, splats, &mut labels, all, Some(&others), fusion.hits, share);
    }
    Ok(Labelled { labels, parts_removed })
}

/// From beliefs to the selection, still without visits. `prompted`: what the prompts say, and of it what their masks say.
fn decide(
    request: &Request,
    fusion: &LabelFusion,
    (prompted, masks): (&Evidence, &Evidence),
    state: FusionState,
) -> Result<Selection, SegmentError> {
    let Labelled { mut labels, parts_removed } = labelled(request, fusion, prompted, &state)?;
    let sum = |of: &[f32], labelled: bool| -> f64 {
        of.iter().zip(&labels).filter(|(_, l)| **l || !labelled).map(|(x, _)| f64::from(*x)).sum()
    };
    let either = sum(&masks.inside, false) + sum(&masks.outside, true);
    let agreement = if either > 0.0 { sum(&masks.inside, true) / either } else { 1.0 };
    let left_out = request.seen_once.and_then(|once| seen_once::leave_out(&mut labels, once));
    // No piece of them joins the object either.
    let frozen: Option<Vec<bool>> = match (request.frozen, left_out.and(request.seen_once)) {
        (Some(frozen), Some(once)) => Some(frozen.iter().zip(once).map(|(a, b)| *a || *b).collect()),
        (frozen, once) => frozen.or(once).map(<[bool]>::to_vec),
    };
    Ok(Selection {
        labels,
        score: state.probability,
        similarity: fusion.similarities.as_ref().map(|s| s.positive.clone()),
        evidence: state.evidence,
        visits: Vec::new(),
        frozen,
        parts_removed,
        seen_once: left_out.unwrap_or(0),
        agreement: agreement as f32,
        alone: false,
    })
}

/// Unselected splats that lie astride the outline and are connected to the selection, through one another where need be. What
/// fills the masks from far in the background does not reach into the object: no piece of it belongs there.
fn astride(request: &Request, selection: &Selection) -> Vec<bool> {
    let (labels, evidence) = (&selection.labels, &selection.evidence);
    let mut astride: Vec<bool> = (0..request.splats.len())
        .map(|i| {
            let barred = labels[i] || selection.frozen.as_ref().is_some_and(|f| f[i]);
            !barred
                && evidence.known[i] >= ASTRIDE_COVERAGE
                && evidence.rho(i).is_some_and(|rho| rho >= ASTRIDE_SHARE)
        })
        .collect();
    let mut built = None;
    let graph = request.graph(&mut built);
    let either: Vec<bool> = labels.iter().zip(&astride).map(|(label, astride)| *label || *astride).collect();
    let (part, parts) = graph.components(request.splats, &either);
    let mut holds_selected = vec![false; parts];
    for (part, _) in part.iter().zip(labels).filter(|(_, label)| **label) {
        holds_selected[part.expect("a selected splat is in a part") as usize] = true;
    }
    for (astride, part) in astride.iter_mut().zip(&part) {
        *astride &= part.is_some_and(|part| holds_selected[part as usize]);
    }
    astride
}

/// The spike cut of a selection (method, section 7) by the masks of the photos that took part, or of the prompted
/// ones alone ([`crate::SegmentSettings::cut_by`]). A photo cuts only the splats that it sees.
pub fn cut(request: &Request, selection: &Selection) -> Result<SpikeCut, SegmentError> {
    let accepted = || selection.visits.iter().filter_map(|v| Some((v, v.mask.as_ref()?)));
    if request.settings.cut_by == CutBy::PhotoRefiner && accepted().next().is_some() {
        let own: Vec<Vec<u8>> = meant(request)
            .map(|prompt| Ok(prompted_evidence(request, prompt)?.visibility()))
            .collect::<Result<_, SegmentError>>()?;
        let mask_vote = |view: usize, mask, visibility, weight| {
            let view = &request.views[view];
            MaskVote { camera: view.camera, pose: view.pose, mask, visibility, weight }
        };
        let weight = request.settings.prompt_weight;
        let prompted =
            meant(request).zip(&own).map(|(p, visibility)| mask_vote(p.view, p.mask, visibility, weight));
        let others = accepted().map(|(v, mask)| mask_vote(v.view, mask, &v.visibility, v.agreement));
        let votes: Vec<MaskVote> = prompted.chain(others).collect();
        let settings = request.settings;
        let near = request.options.near;
        let astride = astride(request, selection);
        let labels = &selection.labels;
        return Ok(SpikeCut::cut_by_votes(request.splats, labels, &astride, &votes, settings.spikes, near));
    }
    let mut sees = Vec::with_capacity(request.prompts.len());
    for prompt in meant(request) {
        let view = view(request, prompt.view)?;
        let camera = working_camera(request, view, Some(prompt.mask));
        let projected = project(request, view, &camera)?;
        let seen = visible(&*projected, (camera.width, camera.height));
        sees.push(seen.map_err(SegmentError::raster(&view.name))?);
    }
    let views: Vec<CutView> = meant(request)
        .zip(&sees)
        .map(|(prompt, sees)| {
            let view = &request.views[prompt.view];
            CutView { camera: view.camera, pose: view.pose, mask: prompt.mask, sees: Some(sees) }
        })
        .collect();
    Ok(SpikeCut::new(
        request.splats,
        &selection.labels,
        &views,
        request.settings.spikes,
        request.options.near,
    ))
}

/// The prompted photos whose mask is of the object, not of a refused thing.
fn meant<'a>(request: &Request<'a>) -> impl Iterator<Item = &'a PromptedView<'a>> {
    request.prompts.iter().filter(|p| !p.refused)
}

fn none_left(labels: &[bool], reason: &'static str) -> Result<(), SegmentError> {
    if labels.contains(&true) { Ok(()) } else { Err(SegmentError::NothingSelected { reason }) }
}

fn check(request: &Request) -> Result<(), SegmentError> {
    let n = request.splats.len();
    let fits = |what: &str, len: usize| {
        if len == n { Ok(()) } else { Err(SegmentError::Shape(format!("{len} {what} for {n} splats"))) }
    };
    fits("rows of features", request.features.map_or(n, SplatFeatures::len))?;
    fits("nodes of the neighbour graph", request.graph.map_or(n, NeighbourGraph::len))?;
    fits("frozen flags", request.frozen.map_or(n, <[bool]>::len))?;
    fits("flags of what is seen once", request.seen_once.map_or(n, <[bool]>::len))?;
    if meant(request).next().is_none() {
        return Err(SegmentError::NoPrompt);
    }
    let s = request.settings;
    let open_unit = [("spread_decay", s.spread_decay), ("unseen_prior", s.unseen_prior)];
    for (name, value) in open_unit {
        if !(value > 0.0 && value < 1.0) {
            return Err(SegmentError::Setting {
                name,
                value: value.into(),
                reason: "it must lie between 0 and 1",
            });
        }
    }
    if !(0.0..=1.0).contains(&s.rho) {
        return Err(SegmentError::Setting {
            name: "rho",
            value: s.rho.into(),
            reason: "it is a share, from 0 to 1",
        });
    }
    if s.neighbours == 0 || s.neighbours > MOST_NEIGHBOURS {
        let value = s.neighbours as f64;
        return Err(SegmentError::Setting { name: "neighbours", value, reason: "it must be 1 to 256" });
    }
    for prompt in request.prompts {
        let view = view(request, prompt.view)?;
        if prompt.mask.is_empty() {
            return Err(SegmentError::EmptyMask { photo: view.name.clone() });
        }
    }
    Ok(())
}

/// The splats that the positive and the negative clicks hit. A positive click must hit something selectable; a
/// negative one on nothing is ignored.
pub(crate) fn hits(request: &Request) -> Result<(Vec<ClickHit>, Vec<ClickHit>), SegmentError> {
    let (mut positive, mut negative) = (Vec::new(), Vec::new());
    for prompt in request.prompts {
        let view = view(request, prompt.view)?;
        for point in prompt.points {
            let (photo, x, y) = (view.name.clone(), point.x, point.y);
            let at = Vec2::new(x, y);
            if !view.camera.contains(at) {
                let (width, height) = (view.camera.width, view.camera.height);
                return Err(SegmentError::OutsideFrame { photo, x, y, width, height });
            }
            let window = request.settings.click_window.min(64);
            let PosedView { camera, pose, .. } = view;
            let render =
                || crate::hit(request.rasterizer, request.splats, &request.options, camera, pose, at, window);
            let hit = match request.hits {
                Some(known) => known.of(prompt.view, at, window, render),
                None => render(),
            };
            let hit = hit.map_err(SegmentError::raster(&view.name))?;
            if hit.alpha < MIN_CLICK_ALPHA {
                if point.inside {
                    return Err(SegmentError::EmptySpace { photo, x, y, alpha: hit.alpha });
                }
                continue;
            }
            if point.inside {
                let barred = |s: &&(u32, f32)| request.frozen.is_some_and(|f| f[s.0 as usize]);
                let background: f32 = hit.splats.iter().filter(barred).map(|s| s.1).sum();
                if background > 0.5 * hit.alpha {
                    return Err(SegmentError::Background { photo, x, y });
                }
                positive.push(hit);
            } else {
                negative.push(hit);
            }
        }
    }
    Ok((positive, negative))
}

fn similarities(
    request: &Request,
    prompted: &Evidence,
    positive: &[ClickHit],
    negative: &[ClickHit],
) -> Result<Option<Similarities>, SegmentError> {
    let (Some(field), true) = (request.features, request.settings.similarity_use != SimilarityUse::Off)
    else {
        return Ok(None);
    };
    let read = |hits: &[ClickHit]| hits.iter().filter_map(|hit| hit.feature(field)).collect::<Vec<_>>();
    let (queries, refusals) = (read(positive), read(negative));
    if queries.len() < positive.len() {
        tracing::warn!(
            clicks = positive.len(),
            usable = queries.len(),
            "some clicks hit splats without a usable feature"
        );
    }
    if queries.is_empty() {
        return Ok(None);
    }
    let temperature = request.settings.click_temperature;
    let positive = field.similarity(request.backend, &queries, temperature)?;
    let clusters = cluster_features(field, prompted);
    let mut held = if clusters.is_empty() {
        Vec::new()
    } else {
        field.similarity(request.backend, &clusters, temperature)?
    };
    held.iter_mut().zip(&positive).for_each(|(held, clicked)| *held = held.max(*clicked));
    Ok(Some(Similarities {
        positive,
        held,
        negative: if refusals.is_empty() {
            None
        } else {
            Some(field.similarity(request.backend, &refusals, temperature)?)
        },
    }))
}
