//! Carrying a selection from the prompted photos to all others and back: each photo's own boundaries correct
//! the rendered prior, and its evidence decides splats that no prompted photo sees.

use crate::coverage::{clean, soft};
use crate::label_fusion::{FusionState, LEAST_HINT, LabelFusion, SPREAD_STEPS, sure};
use crate::open_views::OpenViews;
use crate::photo_evidence::view_evidence;
use crate::request::{AT_ONCE, project, working_camera};
use crate::steps::{AnswerStep, PUBLISHED_AFTER};
use crate::view_splats::SplatSet;
use crate::{Evidence, Refiner, Request, SegmentError, SegmentSettings};
use crate::{occlusion, thin_structures};
use rayon::prelude::*;
use rayon::{Scope, Yield};
use segwild_raster::{Channels, Projected};
use segwild_scene::{Camera, Image, Mask};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Steps of label spreading after each photo of the first round (method, section 6.3); earlier ones are kept. IoU by half, half
/// more: +.001, +.001 on `sacre_coeur`; 0, 0 on the demo.
const SPREAD_STEPS_PER_PHOTO: u32 = 8;

/// Splats of the object that a view must see to be visited (method, section 6.4). By choice. Half and half more changed no
/// measured click.
const MIN_SHOWN_SPLATS: u32 = 8;

/// Weight `h_c` of a pixel where the photo contradicts what is well known (method, section 6.1): a transient before the object,
/// or a failure of the 2D segmenter, unless other photos agree with it. By choice. Half and half more move IoU by less than
/// .0005.
const CONTRADICTED_WEIGHT: f32 = 0.3;

/// How much must be known of a pixel, and how far the mask must be from the prior there, for a contradiction (method, section
/// 6.1). By choice. Known: Half and half more move IoU by less than .0005. Apart: IoU by half, half more: +.012, 0 on
/// `sacre_coeur`; -.005, 0 on the demo.
const CONTRADICTION: f32 = 0.8;

/// Weight `h_u` of a pixel whose splats have no evidence yet (method, section 6.1): there the mask is the 2D segmenter's guess
/// from the rest of the photo, and another photo may know better. By choice. IoU by half, half more: +.002, 0 on `sacre_coeur`;
/// +.001, 0 on the demo.
const UNKNOWN_WEIGHT: f32 = 0.3;

/// Prior `u_0`, `u_1` of a splat without evidence (method, section 6.4): where it resembles the clicks least, and where it
/// resembles them as much as the rest of the object does. The second is over one half: a part wrongly left out is rendered as
/// background and confirmed by every later photo, while one wrongly included meets photos that contradict it. The first is
/// under one half: what only a few photos show, such as the ground below an object that all others see from below, would
/// otherwise be included for good by the first of them. `u_0`: IoU by half, half more: +.004, -.017 on `sacre_coeur`; -.008,
/// -.092 on the demo. `u_1`: IoU by half, half more: +.024, -.022 on `sacre_coeur`; -.003, -.015 on the demo.
const OPEN_PRIOR: [f32; 2] = [0.4, 0.6];

/// Share `rho_e` of a splat's evidence inside at which its prior is one half (method, section 6.4). Less than one half for the
/// same reason: a part that a third of the masks hold is rendered as part of the object, and each photo decides it by its own
/// boundaries. The share that counts in the end is [`SegmentSettings::rho`]. From
/// docs/experiments/2026-11-24-prior-for-a-partly-supported-part.md. IoU by half, half more: -.008, +.006 on `sacre_coeur`;
/// +.001, -.003 on the demo.
const EVEN_SHARE: f32 = 0.3;

/// Coverage evidence `K_p`, in views, that has a weight of one half in the prior (method, section 6.4): less leaves the splat
/// for the photo to decide. By choice. IoU by half, half more: 0, +.002 on `sacre_coeur`; +.001, +.001 on the demo.
const PRIOR_COVERAGE: f32 = 1.0;

/// Share `d` of a belief against a splat that enters the prior where it comes from its neighbours only (method, section 6.4).
/// By choice. IoU by half, half more: -.010, +.020 on `sacre_coeur`; +.005, -.012 on the demo.
const AGAINST_WEIGHT: f32 = 0.5;

/// The result of carrying the selection to one photo.
#[derive(Clone, Debug, PartialEq)]
pub struct PhotoVisit {
    /// Index of the view.
    pub view: usize,
    /// Whether its mask counts.
    pub verdict: PhotoVerdict,
    /// Agreement (IoU over what was already known) of the refined mask with the rendered selection; 0 where
    /// there was no mask.
    pub agreement: f32,
    /// The refined mask, where it counts.
    pub mask: Option<Mask>,
    /// The refined mask, where it does not count.
    pub refused: Option<Mask>,
    /// How well the view sees each splat, in 1/255 of full weight; empty where the mask does not count, and once spikes are cut.
    pub visibility: Vec<u8>,
}

impl PhotoVisit {
    /// The refined mask, whether it counts or not; `None` where there was none.
    pub fn own_mask(&self) -> Option<&Mask> {
        self.mask.as_ref().or(self.refused.as_ref())
    }

    /// The same photo where it must not count.
    pub(crate) fn disregarded(self) -> PhotoVisit {
        let verdict =
            if self.verdict == PhotoVerdict::Accepted { PhotoVerdict::Disagrees } else { self.verdict };
        let refused = self.mask.or(self.refused);
        PhotoVisit { verdict, mask: None, refused, visibility: Vec::new(), ..self }
    }
}

/// Whether a photo's refined mask counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PhotoVerdict {
    /// It does.
    Accepted,
    /// It disagrees with what is known.
    Disagrees,
    /// The 2D segmenter had no answer.
    Declined,
    /// The object does not show.
    NotVisible,
}

/// Photos that are prepared before their turn in the first round.
const AHEAD: usize = 4;

/// Publishes the answer of a state.
type Publish<'a> = dyn Fn(AnswerStep, &FusionState) + Sync + 'a;

/// Rounds over the other views. In the first, views come in the order of how much of what could be the object is
/// already known in them, and each answer is used at once, while photos that are likely to be next are prepared. The later
/// ones start from the prompts alone with the beliefs of the round before, so that the order no longer matters, and refine
/// several photos at a time.
pub(crate) fn propagate(
    request: &Request,
    fusion: &LabelFusion,
    prompted: Evidence,
    refiner: &dyn Refiner,
    publish: &Publish,
) -> Result<(FusionState, Vec<PhotoVisit>), SegmentError> {
    let first = fusion.weigh(prompted.clone(), Vec::new(), SPREAD_STEPS);
    publish(AnswerStep::Prompted, &first);
    let (mut state, mut visits) =
        rayon::scope(|scope| first_round(request, fusion, first, refiner, publish, scope))?;
    if request.settings.propagate > 1 && visits.len() > PUBLISHED_AFTER {
        publish(AnswerStep::Photos(visits.len()), &state);
    }
    let mut order: Vec<usize> = visits.iter().map(|v| v.view).collect();
    for _ in 1..request.settings.propagate {
        let mut sum = prompted.clone();
        visits.clear();
        // Backwards: a provider that caches the last photos need not encode those again.
        order.reverse();
        let priors = prior_channels(fusion, &state);
        let at_once = request.views_at_once().max(rayon::current_num_threads().min(AT_ONCE));
        for some in order.chunks(at_once) {
            request.wanted()?;
            for (visit, evidence) in visit_photos(request, &priors, some, refiner)? {
                if let Some(evidence) = evidence {
                    sum.add(&evidence, 1.0);
                }
                visits.push(visit);
            }
        }
        let beliefs = std::mem::take(&mut state.beliefs);
        state = fusion.weigh(sum, beliefs, SPREAD_STEPS);
    }
    Ok((state, visits))
}

fn first_round<'s>(
    request: &'s Request<'s>,
    fusion: &LabelFusion,
    mut state: FusionState,
    refiner: &'s dyn Refiner,
    publish: &Publish,
    scope: &Scope<'s>,
) -> Result<(FusionState, Vec<PhotoVisit>), SegmentError> {
    let mut open = OpenViews::of(request, fusion, &state, refiner)?;
    let mut visits: Vec<PhotoVisit> = Vec::new();
    // Photos that are being prepared, or are prepared and will be visited; and whether they are prepared.
    let mut ahead: Vec<(usize, Arc<AtomicBool>)> = Vec::new();
    while visits.len() < open.most() {
        request.wanted()?;
        let mut order = most_known(fusion, &state, open.views());
        if open.is_due(visits.len(), order.is_empty()) {
            let visited: Vec<usize> = visits.iter().map(|visit| visit.view).collect();
            open.select(fusion, &state, &visited)?;
            order = most_known(fusion, &state, open.views());
        }
        // A photo that is no longer open counts until it is prepared, and is then forgotten.
        ahead.retain(|(view, done)| {
            let stays = open.contains(*view) || !done.load(Ordering::Acquire);
            if !stays {
                refiner.forget(*view);
            }
            stays
        });
        let Some((&next, likely)) = order.split_first() else {
            // No open view shows a decided part of the object.
            break;
        };
        if rayon::current_num_threads() > 1 {
            for &view in likely.iter().take(open.most() - visits.len() - 1) {
                if ahead.len() < AHEAD && ahead.iter().all(|(other, _)| *other != view) {
                    let done = Arc::new(AtomicBool::new(false));
                    ahead.push((view, done.clone()));
                    scope.spawn(move |_| {
                        if request.wanted().is_ok() {
                            refiner.prepare(view);
                        }
                        done.store(true, Ordering::Release);
                    });
                }
            }
        }
        open.take(next);
        if let Some(at) = ahead.iter().position(|(view, _)| *view == next) {
            // While another thread prepares this photo, this thread prepares the next ones.
            let (_, done) = ahead.swap_remove(at);
            while !done.load(Ordering::Acquire) && rayon::yield_now() == Some(Yield::Executed) {}
        }
        let (visit, evidence) = visit_photo(request, &prior_channels(fusion, &state), next, refiner)?;
        if let Some(evidence) = evidence {
            let FusionState { evidence: mut sum, beliefs, .. } = state;
            sum.add(&evidence, 1.0);
            state = fusion.weigh(sum, beliefs, SPREAD_STEPS_PER_PHOTO);
        }
        visits.push(visit);
        if visits.len() == PUBLISHED_AFTER {
            publish(AnswerStep::Photos(PUBLISHED_AFTER), &state);
        }
    }
    Ok((state, visits))
}

/// The open views that show a decided part of the object, those first of which the largest share of what could be the
/// object is decided.
fn most_known(fusion: &LabelFusion, state: &FusionState, open: &[(usize, Arc<SplatSet>)]) -> Vec<usize> {
    let n = state.probability.len();
    let SegmentSettings { rho, gamma, least_evidence, .. } = *fusion.settings;
    let label = |i: usize| state.evidence.label(i, rho, gamma, least_evidence);
    let object = SplatSet::of(n, |i| !fusion.is_frozen(i) && label(i) == Some(true));
    // Frozen splats count here: a photo of which the object's background is frozen is not the better known for it. Visiting
    // such photos first let the table behind a toy into the selection.
    let could_be = SplatSet::of(n, |i| label(i) != Some(false));
    let mut shares: Vec<(f32, usize)> = open
        .iter()
        .filter_map(|(view, seen)| {
            let known = seen.overlap(&object);
            (known >= MIN_SHOWN_SPLATS).then(|| (known as f32 / seen.overlap(&could_be) as f32, *view))
        })
        .collect();
    shares.sort_by(|(a, v), (b, w)| b.total_cmp(a).then(v.cmp(w)));
    shares.into_iter().map(|(_, view)| view).collect()
}

/// Prior of a splat for a photo: the evidence of the masks, and where that is little, the belief of its neighbours. A
/// belief against a splat from its neighbours alone counts less than one for it: a photo that gets the splat as outside
/// would confirm that, and so would all later ones. Resemblance to the clicks only lowers the prior of what surely is
/// something else: the clicks show one side of the object, and the photo's own boundaries decide the other side better.
fn certainty_of(fusion: &LabelFusion, state: &FusionState, splat: usize) -> f32 {
    if fusion.is_frozen(splat) {
        return 0.0;
    }
    let known = state.evidence.known[splat];
    let reliability = known / (known + PRIOR_COVERAGE);
    let resembles = ((state.hint[splat] - LEAST_HINT) / (0.5 - LEAST_HINT)).clamp(0.0, 1.0);
    let open = OPEN_PRIOR[0] + (OPEN_PRIOR[1] - OPEN_PRIOR[0]) * resembles;
    let around = state.beliefs[splat].probability(open);
    let rest = if around < open { open + AGAINST_WEIGHT * (around - open) } else { around };
    let masks = state.evidence.rho(splat).map_or(0.0, leaning);
    (masks * reliability + (1.0 - reliability) * rest).clamp(0.0, 1.0)
}

/// Prior of a splat with this share of its evidence inside: its odds relative to those of [`EVEN_SHARE`].
fn leaning(share: f32) -> f32 {
    let (inside, outside) = (share * (1.0 - EVEN_SHARE), (1.0 - share) * EVEN_SHARE);
    inside / (inside + outside)
}

/// Per splat, three channels to render: its prior, how much is known of it, and how surely it resembles the clicks.
fn prior_channels(fusion: &LabelFusion, state: &FusionState) -> Vec<f32> {
    let mut channels = vec![0.0; 3 * state.beliefs.len()];
    let splats = channels.par_chunks_exact_mut(3).zip(&state.beliefs).enumerate().with_min_len(1024);
    splats.for_each(|(i, (out, belief))| {
        out.copy_from_slice(&[certainty_of(fusion, state, i), belief.weight.min(1.0), sure(state.hint[i])]);
    });
    channels
}

/// The rendered prior that a photo refines, with what else is rendered for its evaluation.
struct RefineQuery {
    view: usize,
    camera: Camera,
    /// Per pixel, how likely it is inside: the prior.
    certainty: Image,
    /// Per pixel, how much is known there.
    known: Vec<f32>,
    /// Per pixel, how surely the splats there resemble the clicks.
    resembles: Vec<f32>,
}

/// A refined mask and how far it is trusted, in [0, 1]; `None` where the refiner declined.
type RefinerAnswer = Option<(Mask, f32)>;

/// Renders the prior into a view, lets the photo refine it, and weighs the answer.
fn visit_photo(
    request: &Request,
    priors: &[f32],
    index: usize,
    refiner: &dyn Refiner,
) -> Result<(PhotoVisit, Option<Evidence>), SegmentError> {
    let view = &request.views[index];
    let camera = working_camera(request, view, None);
    let projected = project(request, view, &camera)?;
    let query = render_query(request, priors, index, &camera, &*projected)?;
    let answer = query.shows().then(|| refiner.refine(index, &query.certainty));
    weigh_answer(request, &query, &*projected, answer)
}

/// As [`visit_photo`] for photos that share one prior. Where the views cannot be projected at once
/// ([`Request::views_at_once`]), only the refining runs in parallel, and each is projected twice: once for its prior, and once
/// more for its evidence.
fn visit_photos(
    request: &Request,
    priors: &[f32],
    some: &[usize],
    refiner: &dyn Refiner,
) -> Result<Vec<(PhotoVisit, Option<Evidence>)>, SegmentError> {
    if request.views_at_once() > 1 {
        return request.in_views(some, |&index| visit_photo(request, priors, index, refiner));
    }
    let projected = |index: usize| {
        let view = &request.views[index];
        let camera = working_camera(request, view, None);
        Ok((camera, project(request, view, &camera)?))
    };
    let mut queries = Vec::with_capacity(some.len());
    for &index in some {
        let (camera, projected) = projected(index)?;
        queries.push(render_query(request, priors, index, &camera, &*projected)?);
    }
    let ask = |q: &RefineQuery| q.shows().then(|| refiner.refine(q.view, &q.certainty));
    let answers: Vec<Option<RefinerAnswer>> = queries.par_iter().map(ask).collect();
    let answered = queries.iter().zip(answers);
    answered.map(|(query, answer)| weigh_answer(request, query, &*projected(query.view)?.1, answer)).collect()
}

impl RefineQuery {
    /// Whether the object is in sight, for the photo to give evidence.
    fn shows(&self) -> bool {
        self.certainty.data.iter().any(|c| *c > 0.5)
    }
}

/// Renders the query for a photo.
fn render_query(
    request: &Request,
    priors: &[f32],
    index: usize,
    camera: &Camera,
    projected: &dyn Projected,
) -> Result<RefineQuery, SegmentError> {
    let view = &request.views[index];
    let frame =
        projected.blend(&Channels { count: 3, values: priors }).map_err(SegmentError::raster(&view.name))?;
    let mut certainty = Image {
        width: camera.width as usize,
        height: camera.height as usize,
        channels: 1,
        data: frame.image.plane(0).iter().map(|&x| clean(x)).collect(),
    };
    let missing = match request.skies.and_then(|read| read(index)) {
        Some(sky) => thin_structures::complete(&mut certainty, &frame.alpha, &sky),
        None => vec![0.0; certainty.data.len()],
    };
    // Where there is no splat, and none is missing, there is no object: that, too, is known.
    let known: Vec<f32> = frame
        .image
        .plane(1)
        .iter()
        .zip(&frame.alpha.data)
        .zip(&missing)
        .map(|((&d, &a), l)| clean(d + 1.0 - a - l))
        .collect();
    let resembles = frame.image.plane(2).to_vec();
    Ok(RefineQuery { view: index, camera: *camera, certainty, known, resembles })
}

/// Weighs a photo's answer; `None` if it was not queried.
fn weigh_answer(
    request: &Request,
    query: &RefineQuery,
    projected: &dyn Projected,
    answer: Option<RefinerAnswer>,
) -> Result<(PhotoVisit, Option<Evidence>), SegmentError> {
    let RefineQuery { view: index, camera, certainty, known, resembles } = query;
    let (index, view) = (*index, &request.views[*index]);
    let verdict = |verdict, agreement, refused| {
        let visibility = Vec::new();
        (PhotoVisit { view: index, verdict, agreement, mask: None, refused, visibility }, None)
    };
    let (mask, confidence) = match answer {
        None => return Ok(verdict(PhotoVerdict::NotVisible, 0.0, None)),
        Some(None) => return Ok(verdict(PhotoVerdict::Declined, 0.0, None)),
        Some(Some(refined)) => refined,
    };
    let inside = soft(&mask, camera.width, camera.height);
    // An occluded pixel is no disagreement. Where the mask leaves it out, it has little or no weight.
    let transients = request.transients_in(index);
    let pixel_visibility = occlusion::pixel_visibility(&inside, transients.as_ref(), Some(resembles), camera);
    let (mut both, mut either) = (0.0f64, 0.0f64);
    for (((&m, &c), &k), &h) in inside.iter().zip(&certainty.data).zip(known).zip(&pixel_visibility) {
        let (believed, k) = (f32::from(u8::from(c > 0.5)), k * h);
        both += f64::from(k * m.min(believed));
        either += f64::from(k * m.max(believed));
    }
    let agreement = if either > 0.0 { (both / either) as f32 } else { 0.0 };
    let confidence = clean(confidence);
    if agreement < request.settings.propagate_gate || confidence == 0.0 {
        let refused = (confidence > 0.0).then_some(mask);
        return Ok(verdict(PhotoVerdict::Disagrees, agreement, refused));
    }
    let trust = confidence * agreement;
    let weights: Vec<f32> = inside
        .iter()
        .zip(&certainty.data)
        .zip(known)
        .zip(&pixel_visibility)
        .map(|(((&m, &c), &k), &h)| {
            h * if k > CONTRADICTION && (m - c).abs() > CONTRADICTION {
                CONTRADICTED_WEIGHT
            } else {
                UNKNOWN_WEIGHT + (1.0 - UNKNOWN_WEIGHT) * k
            }
        })
        .collect();
    let mut evidence = Evidence::none(request.splats.len());
    let seen = view_evidence(request, projected, view, camera, &mask, &weights)?;
    evidence.add(&seen, trust);
    let visibility = seen.visibility();
    let (verdict, mask) = (PhotoVerdict::Accepted, Some(mask));
    Ok((PhotoVisit { view: index, verdict, agreement, mask, refused: None, visibility }, Some(evidence)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The plinth that every photo left out because the photo before it had.
    #[test]
    fn a_part_that_a_third_of_the_masks_hold_has_a_prior_over_one_half() {
        assert!((leaning(EVEN_SHARE) - 0.5).abs() < 1e-6);
        assert!(leaning(0.34) > 0.5 && leaning(0.25) < 0.5);
        assert_eq!((leaning(0.0), leaning(1.0)), (0.0, 1.0));
        assert!((1..=20).all(|k| leaning(k as f32 / 20.0) > leaning((k - 1) as f32 / 20.0)));
    }
}
