//! What tells the meant set from the others: numbers about a set of superpixels, about what it changes of the set before it,
//! and about how both lie around the click.

use super::pool::Ground;
use super::shape::Shape;

/// Numbers per candidate.
pub(crate) const COUNT: usize = 27;

/// Why a candidate is looked at: what a prompt asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// The first click.
    First,
    /// A click that what was chosen so far leaves out.
    Add,
    /// A click that what was chosen so far wrongly holds.
    Remove,
    /// A box, with or without a click.
    Boxed,
}

/// A click as distances.
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

/// Where a candidate comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// A region added to what was chosen so far, or taken from it.
    Region,
    /// A region in its place.
    Instead,
    /// A cut.
    Cut,
}

/// A candidate beside what was chosen so far.
pub(crate) struct Candidate<'a> {
    pub whole: &'a Shape,
    /// What it changes, and the superpixels of that; at the first step the whole.
    pub part: &'a Shape,
    pub changed: &'a [bool],
    /// Share of the photo that was chosen so far.
    pub before: f32,
    /// What it changes the other way round than the click asks, as a share of what was chosen so far.
    pub undone: f32,
    /// How well the region stands in its tree.
    pub standing: f32,
    /// How well it fills the box.
    pub tight: f32,
    pub source: Source,
}

/// The numbers.
pub(crate) fn traits(candidate: &Candidate, around: &Around) -> [f32; COUNT] {
    let Candidate { whole, part, before, .. } = *candidate;
    let place = |s: &Shape| {
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
        place(part),
        round.min(1.5),
        thin.min(2.0),
        (thin.min(2.0)).powi(2),
        if before > 0.0 { log(part.share / before).clamp(-8.0, 8.0) } else { 0.0 },
        candidate.undone.min(1.0),
        candidate.standing,
        candidate.tight,
        f32::from(u8::from(candidate.source == Source::Cut)),
    ]
}
