//! Traits of a candidate mask: numbers about its set of superpixels, about what it changes of the set before it, and about how
//! both lie around the click. They separate the mask that is meant from the others.

use super::pool::Ground;
use super::shape::SetShape;

/// Numbers per candidate.
pub(crate) const COUNT: usize = 27;

/// The kind of a prompt, given the answer so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PromptStep {
    /// The first click.
    First,
    /// A positive click outside the answer so far.
    Add,
    /// A negative click inside the answer so far.
    Remove,
    /// A box, with or without a click.
    Boxed,
}

/// Distances from a click.
pub(crate) struct Around {
    pub at: [f32; 2],
    /// Least distance of every superpixel's pixels.
    near: Vec<f32>,
    /// Distance to the photo's frame.
    frame: f32,
}

impl Around {
    /// Measures a photo from a click.
    pub fn of(ground: &Ground, at: [f32; 2]) -> Around {
        let tree = &ground.analysis.tree;
        let mut near = vec![f32::MAX; tree.leaves];
        for (i, &label) in tree.labels.iter().enumerate() {
            let (x, y) = ((i % tree.width) as f32 + 0.5 - at[0], (i / tree.width) as f32 + 0.5 - at[1]);
            let n = &mut near[label as usize];
            *n = n.min(x * x + y * y);
        }
        near.iter_mut().for_each(|n| *n = n.sqrt());
        let frame = at[0].min(at[1]).min(tree.width as f32 - at[0]).min(tree.height as f32 - at[1]);
        Around { at, near, frame: frame.max(0.5) }
    }

    /// Distance from the click to the nearest pixel that is not in the set.
    fn depth(&self, set: &[bool]) -> f32 {
        self.near.iter().zip(set).filter(|(_, s)| !**s).map(|(&n, _)| n).fold(self.frame, f32::min)
    }
}

fn log(share: f32) -> f32 {
    share.max(1e-5).log2()
}

/// How a candidate was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CandidateSource {
    /// A region added to the answer so far, or removed from it.
    Region,
    /// A region instead of the answer so far.
    Instead,
    /// A graph cut.
    Cut,
}

/// What the traits of a candidate are computed from.
pub(crate) struct TraitInputs<'a> {
    pub whole: &'a SetShape,
    /// The part that it changes, and that part's superpixels; at the first step the whole.
    pub part: &'a SetShape,
    pub changed: &'a [bool],
    /// Share of the photo that the answer so far covers.
    pub before: f32,
    /// Area that it changes against the click's direction, as a share of the answer so far.
    pub undone: f32,
    /// How well the region stands in its tree.
    pub standing: f32,
    /// How well it fills the box.
    pub tight: f32,
    pub source: CandidateSource,
}

/// The traits of a candidate, in the order of the learned weights.
pub(crate) fn traits(candidate: &TraitInputs, around: &Around) -> [f32; COUNT] {
    let TraitInputs { whole, part, before, .. } = *candidate;
    let off_centre = |s: &SetShape| {
        let size = (s.share * s.total).sqrt().max(1.0);
        let (dx, dy) = (around.at[0] - s.middle[0], around.at[1] - s.middle[1]);
        ((dx * dx + dy * dy).sqrt() / size).min(2.0)
    };
    let area = (part.share * part.total).max(1.0);
    let depth = around.depth(candidate.changed);
    // The depth of a disc of the same area is what a click in the middle of something round has.
    let round = depth / (area / std::f32::consts::PI).sqrt();
    let thin = depth * part.outline / (2.0 * area);
    [
        whole.clarity,
        whole.open,
        whole.inner,
        whole.framed,
        whole.compact,
        whole.filled,
        whole.contrast,
        log(whole.share),
        log(whole.share).powi(2),
        part.clarity,
        part.open,
        part.inner,
        part.framed,
        part.compact,
        part.filled,
        part.contrast,
        log(part.share),
        log(part.share).powi(2),
        off_centre(part),
        round.min(1.5),
        thin.min(2.0),
        (thin.min(2.0)).powi(2),
        if before > 0.0 { log(part.share / before).clamp(-8.0, 8.0) } else { 0.0 },
        candidate.undone.min(1.0),
        candidate.standing,
        candidate.tight,
        f32::from(u8::from(candidate.source == CandidateSource::Cut)),
    ]
}
