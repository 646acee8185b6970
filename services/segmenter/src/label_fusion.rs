//! Label fusion: masks, features and neighbours are weighed here, from evidence to beliefs to labels.

use crate::settings::{ComponentRule, SegmentSettings, SimilarityUse, Undecided};
use crate::spread::{Belief, spread};
use crate::{ClickHit, Evidence, NeighbourGraph, components};
use rayon::prelude::*;
use segwild_scene::Splats;
use std::borrow::Cow;

/// Steps `n` of label spreading before anything is decided (method, section 6.3): a label of weight 1 then has a decay of
/// `.97^64 = .14`. Half and half more changed no measured click.
pub(crate) const SPREAD_STEPS: u32 = 64;

/// Coverage evidence `K_b`, in views, that makes a splat half known (method, section 6.3). By choice. IoU by half, half more:
/// -.009, 0 on `sacre_coeur`; -.002, +.001 on the demo.
const BELIEF_COVERAGE: f32 = 0.2;

/// Coverage evidence `eta`, in views, of resemblance alone where it is certain (method, section 6.3). It never counts against a
/// splat. By choice; twenty times as much is in docs/experiments/2026-11-26-small-coverage.md. IoU by half, half more: 0, 0 on
/// `sacre_coeur`; +.002, 0 on the demo.
const RESEMBLANCE_COVERAGE: f32 = 0.1;

/// Splats that one thread weighs at once, at least.
const CHUNK: usize = 1024;

/// Bins of the similarity from which the prior is learned.
const BINS: usize = 24;

/// Coverage evidence `s_0`, in splats, that both histograms start with, divided among their bins (method, section 6.2). By
/// choice. Half and half more move IoU by less than .0005.
const BIN_COVERAGE: f64 = 4.0;

/// How far down resemblance may move the prior from [`SegmentSettings::unseen_prior`], in odds `o_0` (method, section 6.2). The
/// clicks show one side of an object. How far resemblance to them is to be trusted is learned from the splats that masks
/// decided. The other side of the object may not resemble them: it must stay open until a photo's own boundaries decide it. By
/// choice. IoU by half, half more: -.011, +.002 on `sacre_coeur`; 0, 0 on the demo.
const RESEMBLANCE_ODDS: f64 = 0.5;

/// The lowest probability that resemblance can give at even odds: [`RESEMBLANCE_ODDS`] as a probability.
pub(crate) const LEAST_HINT: f32 = (RESEMBLANCE_ODDS / (1.0 + RESEMBLANCE_ODDS)) as f32;

/// Share of the evidence that a part without a click must hold for its neighbours to follow it (method, section 6.3). By
/// choice. IoU by half, half more: -.007, 0 on `sacre_coeur`; 0, 0 on the demo.
const STRAY_SHARE: f32 = 0.25;

/// Fused similarities of every splat.
pub(crate) struct Similarities {
    /// To the positive clicks.
    pub positive: Vec<f32>,
    /// To the feature clusters of the prompted masks, or to the clicks where that is more; empty: to the clicks.
    pub held: Vec<f32>,
    /// To the negative clicks.
    pub negative: Option<Vec<f32>>,
}

impl Similarities {
    /// Whether a splat resembles what was clicked (paper, Eq. 28; method, section 6).
    fn passes(&self, splat: usize, settings: &SegmentSettings) -> bool {
        let s = self.positive[splat];
        let clear = self.negative.as_ref().is_none_or(|n| s > n[splat] + settings.negative_margin);
        s >= settings.tau && clear
    }

    /// One number in [-1, 1] that grows with the resemblance to the clicks and to the clusters of their masks.
    fn merit(&self, splat: usize) -> f32 {
        let s = self.held.get(splat).copied().unwrap_or(self.positive[splat]);
        self.negative.as_ref().map_or(s, |n| 0.5 * (s - n[splat]))
    }
}

/// Everything that stays the same while evidence comes in.
pub(crate) struct LabelFusion<'a> {
    pub splats: &'a Splats,
    pub graph: &'a NeighbourGraph,
    /// What the clicks hit: inside, and outside.
    pub hits: (&'a [ClickHit], &'a [ClickHit]),
    pub affinities: Cow<'a, [f32]>,
    pub similarities: Option<Similarities>,
    pub frozen: Option<&'a [bool]>,
    pub settings: &'a SegmentSettings,
}

/// The evidence so far and the beliefs that follow from it.
pub(crate) struct FusionState {
    pub evidence: Evidence,
    pub beliefs: Vec<Belief>,
    /// Probability of every splat to lie inside, 0 for frozen ones.
    pub probability: Vec<f32>,
    /// How likely each splat lies inside by its resemblance ([`Similarities::held`]) alone.
    pub hint: Vec<f32>,
}

impl LabelFusion<'_> {
    pub fn is_frozen(&self, splat: usize) -> bool {
        self.frozen.is_some_and(|f| f[splat])
    }

    /// The beliefs that follow from some evidence. Label spreading continues from `beliefs` for `steps` edges.
    pub fn weigh(&self, evidence: Evidence, mut beliefs: Vec<Belief>, steps: u32) -> FusionState {
        let n = self.graph.len();
        let stray = self.stray(&evidence);
        let prior = self.prior(&evidence);
        let hint = |i: usize| match (&prior, &self.similarities) {
            (Some(bins), Some(s)) => bins[bin(s.merit(i))],
            _ => self.settings.unseen_prior,
        };
        let hangs = self.hangs_together(&evidence, &stray, &hint);
        let anchors: Vec<Belief> = (0..n)
            .into_par_iter()
            .with_min_len(CHUNK)
            .map(|i| {
                if self.is_frozen(i) {
                    return Belief { inside: 0.0, weight: 1.0 };
                }
                // Resemblance to the clicks counts a little as evidence, and more the more certain it is.
                let hint = hint(i);
                let say = if hangs[i] { RESEMBLANCE_COVERAGE * sure(hint).powi(2) } else { 0.0 };
                let (mut inside, mut total) = (hint * say, say);
                if !stray[i] {
                    inside += evidence.sides(i).0;
                    total += evidence.known[i];
                }
                if total == 0.0 {
                    return Belief::default();
                }
                let weight = total / (total + BELIEF_COVERAGE);
                Belief { inside: inside / total * weight, weight }
            })
            .collect();
        spread(self.graph, &self.affinities, &anchors, self.settings.spread_decay, steps, &mut beliefs);
        let hints: Vec<f32> = (0..n).into_par_iter().with_min_len(CHUNK).map(hint).collect();
        let probability = (0..n)
            .into_par_iter()
            .with_min_len(CHUNK)
            .map(|i| if self.is_frozen(i) { 0.0 } else { beliefs[i].probability(hints[i]).clamp(0.0, 1.0) })
            .collect();
        FusionState { evidence, beliefs, probability, hint: hints }
    }

    /// Splats inside the masks whose connected part holds neither a click nor much evidence: a mask that
    /// reaches a few pixels past the outline holds slivers of the background, at any depth. Their labels must not
    /// spread to their neighbours.
    fn stray(&self, evidence: &Evidence) -> Vec<bool> {
        let n = self.graph.len();
        if self.settings.components == ComponentRule::All {
            return vec![false; n];
        }
        let SegmentSettings { rho, gamma, least_evidence: least, .. } = *self.settings;
        let inside: Vec<bool> = (0..n)
            .into_par_iter()
            .with_min_len(CHUNK)
            .map(|i| !self.is_frozen(i) && evidence.label(i, rho, gamma, least) == Some(true))
            .collect();
        let mut kept = inside.clone();
        components::keep_clicked(self.graph, self.splats, &mut kept, evidence, None, self.hits, STRAY_SHARE);
        inside.iter().zip(&kept).map(|(inside, kept)| *inside && !kept).collect()
    }

    /// Splats connected to those inside the masks, through splats that resemble the clicks and that no mask puts
    /// outside. Another object may resemble the clicked one: resemblance without connection is no evidence.
    fn hangs_together(&self, evidence: &Evidence, stray: &[bool], hint: &impl Fn(usize) -> f32) -> Vec<bool> {
        let SegmentSettings { rho, gamma, least_evidence: least, .. } = *self.settings;
        let mut reached = vec![false; self.graph.len()];
        let mut open: Vec<usize> = (0..self.graph.len())
            .filter(|&i| {
                !self.is_frozen(i) && !stray[i] && evidence.label(i, rho, gamma, least) == Some(true)
            })
            .collect();
        open.iter().for_each(|&i| reached[i] = true);
        while let Some(i) = open.pop() {
            for edge in self.graph.edges(i) {
                let j = self.graph.neighbour(edge);
                let carries = hint(j) > 0.5 && evidence.label(j, rho, gamma, least) != Some(false);
                if carries && !reached[j] && !self.is_frozen(j) {
                    reached[j] = true;
                    open.push(j);
                }
            }
        }
        reached
    }

    /// How likely a splat of some similarity lies inside, per bin, learned from the splats that masks decided:
    /// the likelihood ratio of the bin, times the odds of [`SegmentSettings::unseen_prior`], made monotone.
    /// Features without information give the same prior to all.
    fn prior(&self, evidence: &Evidence) -> Option<[f32; BINS]> {
        let similarities = self.similarities.as_ref()?;
        if self.settings.similarity_use == SimilarityUse::Off {
            return None;
        }
        let (mut inside, mut outside) =
            ([BIN_COVERAGE / BINS as f64; BINS], [BIN_COVERAGE / BINS as f64; BINS]);
        for i in 0..self.graph.len() {
            let at = bin(similarities.merit(i));
            // What photos hold against frozen splats is true of others that resemble them.
            let (within, beyond) = evidence.sides(i);
            let within = if self.is_frozen(i) { 0.0 } else { within };
            inside[at] += f64::from(within);
            outside[at] += f64::from(beyond);
        }
        let (sum1, sum0) = (inside.iter().sum::<f64>(), outside.iter().sum::<f64>());
        let prior = f64::from(self.settings.unseen_prior);
        let mut pooled: Vec<(f64, f64, usize)> = Vec::with_capacity(BINS);
        let chance = |a: f64, b: f64| {
            let odds = (a / b).max(RESEMBLANCE_ODDS);
            prior * odds / (prior * odds + 1.0 - prior)
        };
        for at in 0..BINS {
            pooled.push((inside[at] / sum1, outside[at] / sum0, 1));
            // Pool adjacent violators: more resemblance never lowers the prior.
            while let [.., a, b] = pooled[..]
                && chance(a.0, a.1) > chance(b.0, b.1)
            {
                pooled.truncate(pooled.len() - 2);
                pooled.push((a.0 + b.0, a.1 + b.1, a.2 + b.2));
            }
        }
        let mut bins = [0.0; BINS];
        let values = pooled.iter().flat_map(|&(a, b, count)| std::iter::repeat_n(chance(a, b) as f32, count));
        bins.iter_mut().zip(values).for_each(|(out, value)| *out = value);
        Some(bins)
    }

    /// The labels: masks decide where they reach, resemblance together with connection elsewhere; or resemblance alone.
    pub fn labels(&self, state: &FusionState) -> Vec<bool> {
        let s = self.settings;
        (0..self.graph.len())
            .into_par_iter()
            .with_min_len(CHUNK)
            .map(|i| {
                if self.is_frozen(i) {
                    return false;
                }
                let passes = |used: bool| !used || self.similarities.as_ref().is_none_or(|x| x.passes(i, s));
                if s.similarity_use == SimilarityUse::Alone {
                    return passes(true);
                }
                match state.evidence.label(i, s.rho, s.gamma, s.least_evidence) {
                    Some(inside) => inside && passes(s.similarity_use == SimilarityUse::Gate),
                    None if s.undecided == Undecided::Out => false,
                    None => {
                        let belief = state.beliefs[i];
                        belief.inside > 0.5 * belief.weight
                            && state.probability[i] > 0.5
                            && passes(s.similarity_use != SimilarityUse::Off)
                    }
                }
            })
            .collect()
    }
}

/// How surely a splat of some [`FusionState::hint`] resembles what was clicked: 0 up to even odds, 1 at certainty.
pub(crate) fn sure(hint: f32) -> f32 {
    (2.0 * hint - 1.0).max(0.0)
}

fn bin(merit: f32) -> usize {
    (((merit + 1.0) * 0.5 * BINS as f32) as usize).min(BINS - 1)
}
