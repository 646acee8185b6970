//! Prompts one after another: how the next click changes the answer so far.
//!
//! A click that agrees with the answer so far changes nothing. One that disagrees is the middle of a mistake: the regions
//! around it, in all trees, are candidates to add or to remove.

use super::cut::GraphCut;
use super::memory::Weighed;
use super::pool::{Ground, RegionSet};
use super::refine::iou_by;
use super::traits::{Around, COUNT, CandidateSource, PromptStep, TraitInputs, traits};
use super::weights::TraitWeights;
use segwild_scene::logit;
use std::collections::HashSet;

/// Cost that no other outweighs.
const NEVER: f32 = 1e6;
/// The most candidates that the answer is chosen from, the likeliest.
const FINALISTS: usize = 60;
/// Temperature of the softmax over scores that gives each candidate's probability: the scores were learned for choosing, and as
/// log odds they are too sure. On `liberty` (13 photos, two clicks each) 1 leaves less open than is good, 3 no more than 2.
const TEMPERATURE: f32 = 2.0;

/// A click as a superpixel and a position, pixels at analysis size.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SuperpixelClick {
    pub leaf: u32,
    pub at: [f32; 2],
    pub inside: bool,
}

impl SuperpixelClick {
    /// The click as bytes, for the key of an answer.
    pub fn bytes(&self) -> impl Iterator<Item = u8> + use<> {
        let position = self.at.map(f32::to_le_bytes);
        position.into_iter().flatten().chain([u8::from(self.inside)])
    }
}

/// A candidate set before it is measured.
struct Next {
    set: Vec<bool>,
    standing: f32,
    source: CandidateSource,
}

/// A candidate mask and its traits.
pub(crate) struct CandidateMask {
    pub region_set: RegionSet,
    pub traits: [f32; COUNT],
}

/// The answer to a prefix of the prompts.
pub(crate) struct PromptAnswer {
    pub set: Vec<bool>,
    /// How likely each superpixel is meant although it is outside; 0 for those inside.
    pub open: Vec<f32>,
    /// Expected IoU with what is meant.
    pub expected: f32,
    /// Probability of the candidates that overlap the answer (IoU 0.75 and more).
    pub alike: f32,
}

impl PromptAnswer {
    /// The empty answer, with nothing open.
    pub fn nothing(superpixels: usize) -> PromptAnswer {
        PromptAnswer {
            set: vec![false; superpixels],
            open: vec![0.0; superpixels],
            expected: 0.0,
            alike: 0.0,
        }
    }

    /// After another answer: what was open before and is still outside stays open, for a further click does not mean that the
    /// ones before it were understood.
    pub fn after(mut self, before: &PromptAnswer) -> PromptAnswer {
        for ((open, was), inside) in self.open.iter_mut().zip(&before.open).zip(&self.set) {
            *open = if *inside { 0.0 } else { open.max(*was) };
        }
        self
    }
}

impl Weighed for PromptAnswer {
    fn bytes(&self) -> usize {
        self.set.len() * (1 + size_of::<f32>()) + 64
    }
}

/// What every candidate must include and exclude.
pub(crate) struct PromptRules<'a> {
    pub clicks: &'a [SuperpixelClick],
    /// Superpixels that may be inside.
    pub open: &'a dyn Fn(usize) -> bool,
    pub bounds: Option<[f32; 4]>,
}

impl PromptRules<'_> {
    fn kept(&self, set: &[bool]) -> bool {
        self.clicks.iter().all(|c| set[c.leaf as usize] == c.inside)
    }
}

/// Every candidate for the next answer: `before` is the answer so far, `click` the last of `rules.clicks` (`None`: a box alone).
pub(crate) fn candidate_masks(
    ground: &Ground,
    rules: &PromptRules,
    before: &[bool],
    click: Option<SuperpixelClick>,
    step: PromptStep,
    more: Vec<Vec<bool>>,
    starts: &[u32],
) -> Vec<CandidateMask> {
    let mut known: HashSet<Vec<bool>> = HashSet::new();
    let mut options: Vec<Next> = Vec::new();
    let mut keep = |mut set: Vec<bool>, standing: f32, source: CandidateSource| {
        set.iter_mut().enumerate().for_each(|(i, s)| *s &= (rules.open)(i));
        if source == CandidateSource::Cut {
            rules.clicks.iter().for_each(|c| set[c.leaf as usize] = c.inside);
        }
        if rules.kept(&set) && set.contains(&true) && known.insert(set.clone()) {
            options.push(Next { set, standing, source });
        }
    };
    match step {
        PromptStep::First | PromptStep::Boxed => {
            for &leaf in starts {
                for (set, standing) in ground.sets(leaf) {
                    keep(set, standing, CandidateSource::Region);
                }
            }
        }
        PromptStep::Add => {
            let leaf = click.map_or(0, |c| c.leaf);
            for (set, standing) in ground.sets(leaf) {
                let both = set.iter().zip(before).map(|(a, b)| *a || *b).collect();
                keep(both, standing, CandidateSource::Region);
                keep(set, standing, CandidateSource::Instead);
            }
        }
        PromptStep::Remove => {
            let leaf = click.map_or(0, |c| c.leaf);
            for (set, standing) in ground.sets(leaf) {
                let rest: Vec<bool> = before.iter().zip(&set).map(|(b, s)| *b && !*s).collect();
                keep(held_together(ground, rules, &rest), standing, CandidateSource::Region);
                keep(rest, standing, CandidateSource::Region);
            }
            for c in rules.clicks.iter().filter(|c| c.inside) {
                for (set, standing) in ground.sets(c.leaf) {
                    keep(
                        set.iter().zip(before).map(|(s, b)| *s && *b).collect(),
                        standing,
                        CandidateSource::Instead,
                    );
                }
            }
        }
    }
    for set in more {
        keep(set, 0.0, CandidateSource::Cut);
    }
    // Where every region breaks a rule, the answer so far with the click's own superpixel is left.
    if options.is_empty() {
        let mut set = before.to_vec();
        rules.clicks.iter().for_each(|c| set[c.leaf as usize] = c.inside);
        options.push(Next { set, standing: 0.0, source: CandidateSource::Region });
    }
    let around = Around::of(
        ground,
        click.map_or_else(
            || rules.bounds.map_or([0.0; 2], |b| [0.5 * (b[0] + b[2]), 0.5 * (b[1] + b[3])]),
            |c| c.at,
        ),
    );
    let area = ground.area(before);
    let candidate_mask = |o: Next| {
        // What changes, and what changes against the click's direction; the first answer is a change itself.
        let changes = match step {
            PromptStep::First | PromptStep::Boxed => None,
            PromptStep::Add => Some([without(&o.set, before), without(before, &o.set)]),
            PromptStep::Remove => Some([without(before, &o.set), without(&o.set, before)]),
        };
        let undone = changes.as_ref().map_or(0.0, |[_, against]| ground.area(against) / area.max(1.0));
        let whole = ground.region_set(o.set);
        let changed = changes.map(|[changed, _]| ground.region_set(changed));
        let part = changed.as_ref().unwrap_or(&whole);
        let tight = rules.bounds.map_or(0.0, |b| whole.shape.tightness(b));
        let candidate = TraitInputs {
            whole: &whole.shape,
            part: &part.shape,
            changed: &part.inside,
            before: area / whole.shape.total,
            undone,
            standing: o.standing,
            tight,
            source: o.source,
        };
        CandidateMask { traits: traits(&candidate, &around), region_set: whole }
    };
    options.into_iter().map(candidate_mask).collect()
}

/// What one set holds and another does not.
fn without(set: &[bool], other: &[bool]) -> Vec<bool> {
    set.iter().zip(other).map(|(s, o)| *s && !*o).collect()
}

/// The candidate of the highest expected IoU: the one that agrees best with all likely candidates.
pub(crate) fn choose(
    ground: &Ground,
    candidate_masks: Vec<CandidateMask>,
    step: PromptStep,
    weights: &TraitWeights,
) -> PromptAnswer {
    let weights = weights.of(step);
    let score = |o: &CandidateMask| o.traits.iter().zip(weights).map(|(t, w)| t * w).sum::<f32>();
    let mut scored: Vec<(f32, RegionSet)> =
        candidate_masks.into_iter().map(|o| (score(&o), o.region_set)).collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    scored.truncate(FINALISTS);
    let top = scored[0].0;
    let weights: Vec<f32> = scored.iter().map(|s| (s.0 - top).exp()).collect();
    let sum: f32 = weights.iter().sum::<f32>().max(1e-9);
    // The IoU of two sets is the same either way.
    let mut ious = vec![vec![1.0; scored.len()]; scored.len()];
    for i in 0..scored.len() {
        for j in 0..i {
            let iou = iou_by(ground.areas.iter().copied(), &scored[i].1.inside, &scored[j].1.inside);
            (ious[i][j], ious[j][i]) = (iou, iou);
        }
    }
    let mut best = (f32::MIN, 0.0, 0);
    for i in 0..scored.len() {
        let (mut expected, mut alike) = (0.0, 0.0);
        for (j, w) in weights.iter().enumerate() {
            let iou = ious[i][j];
            expected += w / sum * iou;
            alike += if iou >= 0.75 { w / sum } else { 0.0 };
        }
        if expected > best.0 + 1e-6 {
            best = (expected, alike, i);
        }
    }
    let set = scored[best.2].1.inside.clone();
    let chances: Vec<f32> = scored.iter().map(|s| ((s.0 - top) / TEMPERATURE).exp()).collect();
    let sum: f32 = chances.iter().sum();
    let mut open = vec![0.0; set.len()];
    for ((_, region_set), chance) in scored.iter().zip(&chances) {
        for (open, (other, held)) in open.iter_mut().zip(region_set.inside.iter().zip(&set)) {
            *open += if *other && !held { chance / sum } else { 0.0 };
        }
    }
    PromptAnswer { set, open, expected: best.0, alike: best.1 }
}

/// The parts of a set that hold a positive click.
pub(crate) fn held_together(ground: &Ground, rules: &PromptRules, set: &[bool]) -> Vec<bool> {
    let mut out = vec![false; set.len()];
    let mut stack: Vec<u32> = rules.clicks.iter().filter(|c| c.inside).map(|c| c.leaf).collect();
    while let Some(i) = stack.pop() {
        if set[i as usize] && !out[i as usize] {
            out[i as usize] = true;
            stack.extend(&ground.around[i as usize]);
        }
    }
    out
}

/// Graph cuts from the set so far and the click that disagrees with it: colours of inside and outside are learned from the set,
/// with the click's surroundings on the other side.
pub(crate) fn cuts(
    ground: &Ground,
    rules: &PromptRules,
    before: &[bool],
    click: SuperpixelClick,
) -> Vec<Vec<bool>> {
    let tree = &ground.analysis.tree;
    let total = (tree.width * tree.height) as f32;
    // The click's colours: the smallest region around it that is not a crumb, and that holds no other kind of click.
    let other = |r: u32| rules.clicks.iter().any(|c| c.inside != click.inside && tree.holds(r, c.leaf));
    let home = tree
        .chain(click.leaf)
        .take_while(|&r| !other(r) && tree.nodes[r as usize].area < 0.01 * total)
        .last()
        .unwrap_or(click.leaf);
    let side = if click.inside { 1.0 } else { 0.0 };
    let mut belief: Vec<f32> = before.iter().map(|&b| if b { 0.8 } else { 0.15 }).collect();
    let mut weight: Vec<f32> = vec![1.0; tree.leaves];
    for &l in tree.leaves_of(home) {
        (belief[l as usize], weight[l as usize]) = (side, 4.0);
    }
    for c in rules.clicks {
        (belief[c.leaf as usize], weight[c.leaf as usize]) = (if c.inside { 1.0 } else { 0.0 }, 6.0);
    }
    let mut out = Vec::new();
    for reach in [0.08, 0.2] {
        let colour = ground.samples.posterior(&belief, &weight, reach);
        for (trust, old) in [(0.15, 0.5), (0.3, 1.0), (0.3, 0.3)] {
            let mut graph = GraphCut::new(tree.leaves);
            for (i, node) in tree.nodes[..tree.leaves].iter().enumerate() {
                if let Some(c) = rules.clicks.iter().find(|c| c.leaf as usize == i) {
                    let (inside, outside) = if c.inside { (0.0, NEVER) } else { (NEVER, 0.0) };
                    graph.unary(i, inside, outside);
                } else if !(rules.open)(i) {
                    graph.unary(i, NEVER, 0.0);
                } else {
                    let p = colour[i].clamp(0.02, 0.98);
                    let b = belief[i].clamp(0.1, 0.9);
                    let odds = trust * (logit(p) + old * logit(b));
                    graph.unary(i, (-odds).max(0.0) * node.area, odds.max(0.0) * node.area);
                }
            }
            for (&(a, b, border), open) in tree.borders.iter().zip(&ground.open) {
                graph.pair(a as usize, b as usize, border.length * open);
            }
            out.push(graph.solve());
        }
    }
    out
}
