//! From prompts to a mask: chooses among all candidate masks.
//!
//! Prompts are taken one after another ([`super::steps`]): the first click or the boxes choose a set, every further click
//! that disagrees with it corrects it. A granularity picks one of every click's candidate levels instead; negative clicks then
//! remove their parts from it, and positive clicks add theirs.

use super::analysis::Analysis;
use super::cut::GraphCut;
use super::memory::MemorySlot;
use super::nesting::{candidate_levels, level};
use super::pool::{Ground, RegionSet, set_of};
use super::refine::iou_of;
use super::steps::{
    CandidateMask, PromptAnswer, PromptRules, SuperpixelClick, candidate_masks, choose, cuts, held_together,
};
use super::traits::PromptStep;
use super::tree::Hierarchy;
use super::weights::TraitWeights;
use crate::{Prompted, VisionError};
use segwild_scene::{BoxPrompt, Image, Prompts, ScoredMask, logit};
use std::sync::Arc;

/// Cost that no other outweighs.
const NEVER: f32 = 1e6;

/// Share of the chosen set under which an island around a click is a crumb: around the second click, which names another
/// part of the thing more often than it mends the first, and around later ones. With 0.02 for the second, clicks on statue
/// and pedestal of `liberty`'s video1_0020 gave the statue and a patch of the pedestal (.50 of both, now .87); the 60 / 40
/// clicks on its 40 photos say nothing against it (one loses .18, corrections stay as they are).
const CRUMB: [f32; 2] = [0.06, 0.02];

/// Share of the root's altitude that granularity 0 stands for: under it lie crumbs of superpixels.
const FINEST: f32 = 0.1;

/// Altitude that a granularity in [0, 1] stands for.
pub(crate) fn altitude(tree: &Hierarchy, granularity: f32) -> f32 {
    let g = if granularity.is_finite() { granularity.clamp(0.0, 1.0) } else { 0.5 };
    // Just under the root at 1: never the whole photo.
    let top = tree.nodes[tree.root() as usize].altitude;
    0.999 * top * (FINEST + (1.0 - FINEST) * g)
}

/// A person's prompts, as superpixels.
struct Meant {
    /// In the order they were made.
    clicks: Vec<SuperpixelClick>,
    positive: Vec<SuperpixelClick>,
    negative: Vec<SuperpixelClick>,
    /// Bounding box of the boxes within the photo: x0, y0, x1, y1.
    bounds: Option<[f32; 4]>,
    /// Share of every superpixel that lies in the boxes, if there are any.
    boxed: Option<Vec<f32>>,
}

impl Meant {
    fn read(tree: &Hierarchy, prompts: &Prompts) -> Result<Meant, VisionError> {
        let (mut positive, mut negative) = (Vec::new(), Vec::new());
        for p in &prompts.points {
            // Inside the photo; scaling may have rounded it onto the frame.
            let (x, y) = (p.x.clamp(0.0, tree.width as f32 - 0.5), p.y.clamp(0.0, tree.height as f32 - 0.5));
            let leaf = tree.labels[y as usize * tree.width + x as usize];
            let click = SuperpixelClick { leaf, at: [x, y], inside: p.inside };
            if p.inside { positive.push(click) } else { negative.push(click) }
        }
        if !prompts.say_where() {
            return Err(VisionError::Image(
                "nothing says what is wanted: give a click inside the object or a box".into(),
            ));
        }
        negative.retain(|n| positive.iter().all(|p| p.leaf != n.leaf));
        // The first positive click begins; a superpixel that is clicked both ways is inside.
        let mut clicks: Vec<SuperpixelClick> = positive.first().into_iter().copied().collect();
        let mut rest = prompts.points.iter();
        let first = rest.clone().position(|p| p.inside);
        for (k, p) in rest.by_ref().enumerate() {
            let (x, y) = (p.x.clamp(0.0, tree.width as f32 - 0.5), p.y.clamp(0.0, tree.height as f32 - 0.5));
            let leaf = tree.labels[y as usize * tree.width + x as usize];
            let clash = !p.inside && positive.iter().any(|c: &SuperpixelClick| c.leaf == leaf);
            if first != Some(k) && !clash {
                clicks.push(SuperpixelClick { leaf, at: [x, y], inside: p.inside });
            }
        }
        let boxed = (!prompts.boxes.is_empty()).then(|| box_share(tree, &prompts.boxes));
        if let Some(share) = &boxed
            && share.iter().all(|&s| s == 0.0)
        {
            return Err(VisionError::Image("no pixel of the photo lies in the box".into()));
        }
        let bounds = boxed.is_some().then(|| {
            let clamp = |x: f32, n: usize| x.clamp(0.0, n as f32);
            prompts.boxes.iter().fold([f32::MAX, f32::MAX, 0.0f32, 0.0f32], |u, b| {
                [
                    u[0].min(clamp(b.x0.min(b.x1), tree.width)),
                    u[1].min(clamp(b.y0.min(b.y1), tree.height)),
                    u[2].max(clamp(b.x0.max(b.x1), tree.width)),
                    u[3].max(clamp(b.y0.max(b.y1), tree.height)),
                ]
            })
        });
        Ok(Meant { clicks, positive, negative, boxed, bounds })
    }

    /// Superpixels around which candidates are searched.
    fn starts(&self, tree: &Hierarchy) -> Vec<u32> {
        let mut starts: Vec<u32> = self.positive.iter().map(|c| c.leaf).collect();
        if let (true, Some(b)) = (starts.is_empty(), self.bounds) {
            starts = IN_BOX
                .iter()
                .filter_map(|p| tree.leaf_at(b[0] + p[0] * (b[2] - b[0]), b[1] + p[1] * (b[3] - b[1])))
                .collect();
        }
        starts.sort_unstable();
        starts.dedup();
        starts
    }

    /// Superpixels that the prompts touch: those clicked, else those that lie most in the boxes.
    fn touched(&self, tree: &Hierarchy) -> Vec<usize> {
        if !self.positive.is_empty() {
            return self.positive.iter().map(|c| c.leaf as usize).collect();
        }
        let share = self.boxed.as_deref().unwrap_or(&[]);
        let most = share.iter().copied().fold(0.0, f32::max);
        (0..tree.leaves)
            .filter(|&i| share.get(i).is_some_and(|&s| s > 0.0 && s >= 0.5f32.min(most)))
            .collect()
    }
}

/// Positions in a box (shares of its width and height) around which candidates are searched.
const IN_BOX: [[f32; 2]; 9] = [
    [0.5, 0.5],
    [0.5, 0.3],
    [0.5, 0.7],
    [0.3, 0.5],
    [0.7, 0.5],
    [0.3, 0.3],
    [0.7, 0.3],
    [0.3, 0.7],
    [0.7, 0.7],
];

/// Receives the candidate masks of the last prompt.
pub(crate) type CandidateListener<'a> = dyn FnMut(PromptStep, &[CandidateMask]) + 'a;

/// What an answer depends on besides the photo and the prompts.
pub(crate) struct Means<'a, 'h> {
    pub weights: &'a TraitWeights,
    /// The slot of the answer to a prefix of the prompts, given as bytes: a further click need not recompute the answers to the
    /// clicks before it.
    pub kept: &'a dyn Fn(&[u8]) -> MemorySlot<PromptAnswer>,
    pub listener: Option<&'a mut CandidateListener<'h>>,
}

/// The mask that prompts mean, and what they leave open.
pub(crate) fn select(analysis: &Analysis, prompts: &Prompts, means: Means) -> Result<Prompted, VisionError> {
    let meant = Meant::read(&analysis.tree, prompts)?;
    let ground = Ground::of(analysis);
    Ok(match prompts.granularity {
        Some(g) if !meant.positive.is_empty() => Prompted::sure(by_level(&ground, &meant, g)),
        _ => by_evidence(&ground, &meant, means),
    })
}

impl Meant {
    /// The boxes, and the clicks that open superpixels outside of them, as bytes.
    fn box_bytes(&self) -> Vec<u8> {
        let shares = self.boxed.iter().flatten().flat_map(|s| s.to_le_bytes());
        let bounds = self.bounds.iter().flatten().flat_map(|b| b.to_le_bytes());
        shares.chain(bounds).chain(self.positive.iter().flat_map(SuperpixelClick::bytes)).collect()
    }

    /// The expected middle of the object, in pixels.
    fn middle(&self) -> [f32; 2] {
        if let Some(b) = self.bounds {
            return [0.5 * (b[0] + b[2]), 0.5 * (b[1] + b[3])];
        }
        let n = self.positive.len().max(1) as f32;
        self.positive.iter().fold([0.0, 0.0], |m, c| [m[0] + c.at[0] / n, m[1] + c.at[1] / n])
    }

    /// Whether a superpixel may be inside.
    fn open(&self, leaf: usize) -> bool {
        self.boxed.as_ref().is_none_or(|share| share[leaf] >= 0.5)
            || self.positive.iter().any(|c| c.leaf as usize == leaf)
    }

    /// Removes from a set what negative prompts exclude and adds what positive ones include.
    fn repair(&self, ground: &Ground, inside: &mut [bool]) {
        let tree = &ground.analysis.tree;
        let at = self.middle();
        for click in &self.positive {
            if !inside[click.leaf as usize] {
                // The whole with the part is scored, not the part alone.
                let part = likeliest(ground, click, |c| {
                    let fits = !self.negative.iter().any(|n| c.inside[n.leaf as usize]);
                    let both = inside.iter().zip(&c.inside).map(|(&i, &p)| i || p).collect();
                    fits.then(|| ground.region_set(both).shape.likeness(at))
                });
                inside.iter_mut().zip(part).for_each(|(i, p)| *i |= p);
            }
        }
        for click in &self.negative {
            if inside[click.leaf as usize] {
                let part = likeliest(ground, click, |c| {
                    let fits = !self.positive.iter().any(|p| c.inside[p.leaf as usize]);
                    let rest = inside.iter().zip(&c.inside).map(|(&i, &p)| i && !p).collect();
                    fits.then(|| ground.region_set(rest).shape.likeness(at) + c.shape.likeness(click.at))
                });
                inside.iter_mut().zip(part).for_each(|(i, p)| *i &= !p);
            }
        }
        (0..tree.leaves).filter(|&i| !self.open(i)).for_each(|i| inside[i] = false);
    }
}

/// The set around a click of the highest worth; its superpixel where no set has any.
fn likeliest(
    ground: &Ground,
    click: &SuperpixelClick,
    worth: impl Fn(&RegionSet) -> Option<f32>,
) -> Vec<bool> {
    let mut best: Option<(f32, Vec<bool>)> = None;
    for region_set in ground.around(click.leaf) {
        if let Some(score) = worth(&region_set).filter(|s| best.as_ref().is_none_or(|b| *s > b.0)) {
            best = Some((score, region_set.inside));
        }
    }
    best.map_or_else(|| set_of(&ground.analysis.tree, click.leaf), |b| b.1)
}

/// The clicks' candidate levels at one granularity, without what negative clicks or boxes exclude.
fn by_level(ground: &Ground, meant: &Meant, granularity: f32) -> ScoredMask {
    let tree = &ground.analysis.tree;
    let [mut inside, mut strict, mut loose] = [(); 3].map(|()| vec![false; tree.leaves]);
    for click in &meant.positive {
        let sets = ground.around(click.leaf);
        let levels = candidate_levels(&sets, click.at);
        let k = level(levels.len(), granularity);
        let neighbours = [k, k.saturating_sub(1), k + 1];
        for (set, k) in [&mut inside, &mut strict, &mut loose].into_iter().zip(neighbours) {
            match levels.get(k.min(levels.len().saturating_sub(1))) {
                Some(&r) => set.iter_mut().zip(&sets[r].inside).for_each(|(s, &c)| *s |= c),
                None => set[click.leaf as usize] = true,
            }
        }
    }
    meant.repair(ground, &mut inside);
    let region_set = ground.region_set(inside);
    ScoredMask {
        mask: tree.mask(&region_set.inside),
        predicted_iou: predicted_iou(region_set.shape.clarity),
        stability: iou_of(ground.analysis, &strict, &loose),
    }
}

/// Answers the prompts one after another. The answer to a prefix does not depend on the prompts after it.
fn by_evidence(ground: &Ground, meant: &Meant, mut means: Means) -> Prompted {
    let tree = &ground.analysis.tree;
    let open = |i: usize| meant.open(i);
    let nothing = vec![false; tree.leaves];
    let mut bytes = meant.bounds.map_or_else(Vec::new, |_| meant.box_bytes());
    let mut answer = Arc::new(PromptAnswer::nothing(tree.leaves));
    // Boxes are taken together with the first click.
    let boxes_only = usize::from(meant.bounds.is_some() && meant.clicks.is_empty());
    for k in 0..meant.clicks.len() + boxes_only {
        let click = meant.clicks.get(k).copied();
        bytes.extend(click.iter().flat_map(SuperpixelClick::bytes));
        if click.is_some_and(|c| k > 0 && answer.set[c.leaf as usize] == c.inside) {
            continue;
        }
        let listener = means.listener.as_mut().filter(|_| k + 1 >= meant.clicks.len());
        let slot = (means.kept)(&bytes);
        if let (Some(known), None) = (slot.get(), &listener) {
            answer = known.clone();
            continue;
        }
        let rules = PromptRules {
            clicks: &meant.clicks[..(k + 1).min(meant.clicks.len())],
            open: &open,
            bounds: meant.bounds,
        };
        let (step, more, starts) = match (k, click) {
            (0, _) if meant.bounds.is_some() => {
                (PromptStep::Boxed, cuts_in_box(ground, meant), meant.starts(tree))
            }
            (0, Some(c)) => (PromptStep::First, Vec::new(), vec![c.leaf]),
            (_, Some(c)) => {
                let step = if c.inside { PromptStep::Add } else { PromptStep::Remove };
                (step, cuts(ground, &rules, &answer.set, c), Vec::new())
            }
            (_, None) => break,
        };
        let candidate_masks = candidate_masks(ground, &rules, &answer.set, click, step, more, &starts);
        if let Some(listener) = listener {
            listener(step, &candidate_masks);
        }
        let mut next = choose(ground, candidate_masks, step, means.weights);
        // An island around a second click: positive clicks rather mean one object that holds them all, however badly the first
        // click was understood. And nobody clicks to add a crumb.
        let alone = k > 0 && meant.bounds.is_none() && rules.clicks.iter().all(|c| c.inside);
        if let Some(part) = island(ground, &rules, &next.set).filter(|_| alone) {
            let starts: Vec<u32> = rules.clicks.iter().map(|c| c.leaf).collect();
            let first = rules.clicks.first().copied();
            let whole = self::candidate_masks(
                ground,
                &rules,
                &nothing,
                first,
                PromptStep::First,
                Vec::new(),
                &starts,
            );
            let whole = choose(ground, whole, PromptStep::First, means.weights);
            let crumb = CRUMB[usize::from(k > 1)] * ground.area(&next.set);
            let crumb = ground.area(&part) < crumb;
            if crumb || whole.expected > next.expected {
                next = whole;
            }
        }
        answer = slot.get_or_init(|| Arc::new(next.after(&answer))).clone();
    }
    let mut inside = answer.set.clone();
    (0..tree.leaves).filter(|&i| !meant.open(i)).for_each(|i| inside[i] = false);
    // A box or a click always means something: at least what it touches.
    if !inside.contains(&true) {
        meant.touched(tree).into_iter().for_each(|l| inside[l] = true);
    }
    let mut open: Vec<f32> = answer.open.iter().map(|p| p.min(1.0)).collect();
    (0..tree.leaves).filter(|&i| inside[i] || !meant.open(i)).for_each(|i| open[i] = 0.0);
    meant.negative.iter().for_each(|click| close(ground, &mut open, click.leaf));
    let open = tree.labels.iter().map(|&l| open[l as usize]).collect();
    let open = Image { width: tree.width, height: tree.height, channels: 1, data: open };
    let answer = ScoredMask {
        mask: tree.mask(&inside),
        predicted_iou: answer.expected.clamp(0.0, 1.0),
        stability: answer.alike.min(1.0),
    };
    Prompted { answer, open }
}

/// Clears the connected open superpixels around a negative click's: they are not meant.
fn close(ground: &Ground, open: &mut [f32], leaf: u32) {
    let mut stack = vec![leaf];
    while let Some(i) = stack.pop() {
        if std::mem::take(&mut open[i as usize]) > 0.0 {
            stack.extend(&ground.around[i as usize]);
        }
    }
}

/// The last click's part of a set, where it holds none of the clicks before it.
fn island(ground: &Ground, rules: &PromptRules, set: &[bool]) -> Option<Vec<bool>> {
    let (last, others) = rules.clicks.split_last()?;
    let alone = PromptRules { clicks: std::slice::from_ref(last), ..*rules };
    let part = held_together(ground, &alone, set);
    (!others.iter().any(|c| part[c.leaf as usize])).then_some(part)
}

/// Predicted IoU from the mean boundary strength along the outline.
pub(crate) fn predicted_iou(clarity: f32) -> f32 {
    1.0 - 0.5 * (-6.0 * clarity).exp()
}

/// Graph cuts in a box (GrabCut, Rother et al. 2004: outside is known, inside is unknown): colours of inside and outside are
/// learned and the cut repeated; positions near the middle are likelier inside than corners.
fn cuts_in_box(ground: &Ground, meant: &Meant) -> Vec<Vec<bool>> {
    let tree = &ground.analysis.tree;
    let Some(b) = meant.bounds else { return Vec::new() };
    let (cx, cy) = (0.5 * (b[0] + b[2]), 0.5 * (b[1] + b[3]));
    let (rx, ry) = ((0.5 * (b[2] - b[0])).max(1.0), (0.5 * (b[3] - b[1])).max(1.0));
    let centrality: Vec<f32> = ground
        .positions
        .middle
        .iter()
        .map(|m| 1.0 - ((m[0] - cx) / rx).powi(2) - ((m[1] - cy) / ry).powi(2))
        .collect();
    let weight = vec![1.0; tree.leaves];
    let mut out = Vec::new();
    for shift in [-1.0, 0.0, 1.0] {
        let mut belief: Vec<f32> = (0..tree.leaves)
            .map(|i| if meant.open(i) { 0.5 + 0.4 * centrality[i].clamp(-1.0, 1.0) } else { 0.0 })
            .collect();
        for _ in 0..3 {
            let colour = ground.samples.posterior(&belief, &weight, 0.25);
            let mut graph = GraphCut::new(tree.leaves);
            for (i, node) in tree.nodes[..tree.leaves].iter().enumerate() {
                let is = |clicks: &[SuperpixelClick]| clicks.iter().any(|c| c.leaf as usize == i);
                if is(&meant.positive) {
                    graph.unary(i, 0.0, NEVER);
                } else if !meant.open(i) || is(&meant.negative) {
                    graph.unary(i, NEVER, 0.0);
                } else {
                    let odds = 0.15 * (logit(colour[i].clamp(0.02, 0.98)) + centrality[i] + shift);
                    graph.unary(i, (-odds).max(0.0) * node.area, odds.max(0.0) * node.area);
                }
            }
            for (&(a, b, border), open) in tree.borders.iter().zip(&ground.open) {
                graph.pair(a as usize, b as usize, border.length * open);
            }
            let answer = graph.solve();
            for (i, b) in belief.iter_mut().enumerate() {
                *b = if !meant.open(i) {
                    0.0
                } else if answer[i] {
                    0.95
                } else {
                    0.05
                };
            }
            out.push(answer);
        }
    }
    out
}

/// Share of every superpixel that lies in the boxes.
fn box_share(tree: &Hierarchy, boxes: &[BoxPrompt]) -> Vec<f32> {
    let mut plane = vec![0.0; tree.width * tree.height];
    for b in boxes {
        let (x0, x1) = (b.x0.min(b.x1), b.x0.max(b.x1));
        let (y0, y1) = (b.y0.min(b.y1), b.y0.max(b.y1));
        for (i, v) in plane.iter_mut().enumerate() {
            let (x, y) = ((i % tree.width) as f32 + 0.5, (i / tree.width) as f32 + 0.5);
            if x >= x0 && x <= x1 && y >= y0 && y <= y1 {
                *v = 1.0;
            }
        }
    }
    tree.means(&plane)
}
