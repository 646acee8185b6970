//! Boxes against the scene tree: the group whose outline a box is drawn around (method, section 13).

use super::query::{MIN_AREA, apart, expected, rank};
use super::{GroupCandidate, LeafMap, MergeTree, NONE, SceneTree};
use crate::TreeBoundaries;
use crate::box_bounds::{widened, with_margin};
use segwild_scene::{BoxPrompt, Mask};

/// Weight `lambda_r` of a group's rank beside how it fits a box (method, section 13). Other weights of these three change little
/// (docs/experiments/2026-11-30-boxes-by-the-tree.md).
const RANK_WEIGHT: f32 = 0.1;

/// Weight `lambda_o` of a group's IoU with the photo's own mask of a box (method, section 13).
const OWN_MASK_WEIGHT: f32 = 0.5;

/// Weight `lambda_f` of the share of a box that a group fills (method, section 13).
const FILL_WEIGHT: f32 = 0.1;

/// Added to what logarithms are taken of. By choice.
const FLOOR: f32 = 1e-3;

/// How well a group fits its boxes at least, as a product of shares: under that the photos' own masks are more like what is meant
/// (method, section 13). From docs/experiments/2026-11-30-boxes-by-the-tree.md.
const MIN_BOX_FIT: f32 = 0.4;

/// What a photo shows within a box.
pub(crate) struct BoxedLeaves {
    /// The box, in pixels of the leaf map: x0, y0, x1, y1.
    sides: [f32; 4],
    /// Per leaf, its pixels.
    all: Vec<f32>,
    /// Per leaf, its pixels within the box and its margin.
    within: Vec<f32>,
    /// Per leaf, its pixels within the photo's own mask of the box.
    masked: Vec<f32>,
    /// Pixels of that mask; none where it says nothing.
    mask: f32,
    /// Per leaf, x0, y0, -x1, -y1 of the rectangle around its pixels within the box and its margin; infinite where there are none.
    rectangles: Vec<[f32; 4]>,
}

/// How a group fits a box, in shares.
struct BoxFit {
    /// IoU of the box with the rectangle around the group's pixels within the box and its margin, times their share of the group.
    outline: f32,
    /// Share of the box that it fills.
    filled: f32,
    /// IoU with the photo's own mask; 1 where that is empty.
    own_mask: f32,
}

impl BoxFit {
    /// The larger, the better.
    fn weighed(&self) -> f32 {
        let log = |share: f32| (share + FLOOR).ln();
        log(self.outline) + FILL_WEIGHT * log(self.filled) + OWN_MASK_WEIGHT * log(self.own_mask)
    }
}

impl BoxedLeaves {
    /// Of a photo and a tree of so many leaves. The box has the pixels of the map; `mask` is the photo's own mask of it, at any size
    /// that covers the photo edge to edge. `None` where the box shows nothing of the tree.
    pub fn of(map: &LeafMap, leaves: usize, prompt: &BoxPrompt, mask: &Mask) -> Option<BoxedLeaves> {
        let mask = mask.resized(map.width as u32, map.height as u32);
        let (ends, wide) = (widened(prompt, 0.0), with_margin(prompt));
        let (width, height) = (map.width as f32, map.height as f32);
        let sides = [ends.x0.max(0.0), ends.y0.max(0.0), ends.x1.min(width), ends.y1.min(height)];
        let none = || vec![0.0; leaves];
        let (mut all, mut within, mut masked) = (none(), none(), none());
        let mut rectangles = vec![[f32::INFINITY; 4]; leaves];
        for (i, &leaf) in map.leaves.iter().enumerate().filter(|(_, leaf)| **leaf != NONE) {
            let (leaf, x, y) = (leaf as usize, (i % map.width) as f32, (i / map.width) as f32);
            all[leaf] += 1.0;
            masked[leaf] += f32::from(u8::from(mask.index(i)));
            if (wide.x0..wide.x1).contains(&(x + 0.5)) && (wide.y0..wide.y1).contains(&(y + 0.5)) {
                within[leaf] += 1.0;
                rectangles[leaf] = around(rectangles[leaf], [x, y, -x - 1.0, -y - 1.0]);
            }
        }
        let shows = within.iter().any(|&pixels| pixels > 0.0);
        shows.then(|| BoxedLeaves { sides, all, within, masked, mask: mask.count() as f32, rectangles })
    }

    /// How each group of a tree fits the box; `None` where it does not show there.
    fn fits(&self, merges: &MergeTree) -> Vec<Option<BoxFit>> {
        let sums = |of: &[f32]| merges.sums(of);
        let (all, within, masked) = (sums(&self.all), sums(&self.within), sums(&self.masked));
        let mut rectangles = self.rectangles.clone();
        rectangles.resize(merges.len(), [f32::INFINITY; 4]);
        for (node, &parent) in merges.parent.iter().enumerate() {
            rectangles[parent as usize] = around(rectangles[parent as usize], rectangles[node]);
        }
        let [x0, y0, x1, y1] = self.sides;
        let area = ((x1 - x0).max(0.0) * (y1 - y0).max(0.0)).max(1.0);
        let fit = |node: usize| {
            let [left, top, right, bottom] = rectangles[node];
            let both = (x1.min(-right) - x0.max(left)).max(0.0) * (y1.min(-bottom) - y0.max(top)).max(0.0);
            let either = area + (right + left) * (bottom + top) - both;
            let (all, within, masked) = (all[node] as f32, within[node] as f32, masked[node] as f32);
            (within > 0.0).then(|| BoxFit {
                outline: both / either * within / all,
                filled: (within / area).min(1.0),
                own_mask: if self.mask > 0.0 { masked / (all + self.mask - masked) } else { 1.0 },
            })
        };
        (0..merges.len()).map(fit).collect()
    }
}

/// The rectangle around two, each as x0, y0, -x1, -y1.
fn around(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
    [0, 1, 2, 3].map(|k: usize| a[k].min(b[k]))
}

/// What boxes mean.
pub(crate) struct BoxedGroups {
    /// The groups that they may mean, the likeliest first.
    pub groups: Vec<GroupCandidate>,
    /// Whether the likeliest fits all boxes.
    pub fits: bool,
}

impl SceneTree {
    /// The groups that boxes mean, one box in each photo.
    pub(crate) fn groups_in_boxes(&self, boxes: &[BoxedLeaves], boundaries: TreeBoundaries) -> BoxedGroups {
        let mut found = Vec::new();
        for (number, tree) in self.trees_of(boundaries) {
            let fits: Vec<_> = boxes.iter().map(|leaves| leaves.fits(&tree.merges)).collect();
            for (at, gap) in tree.relative_gaps().into_iter().enumerate() {
                let (node, area) = (at as u32, tree.groups[at].area);
                let shown: Option<Vec<&BoxFit>> = fits.iter().map(|fits| fits[at].as_ref()).collect();
                let Some(shown) = shown.filter(|_| area >= MIN_AREA) else { continue };
                let fit = shown.iter().map(|fit| fit.weighed()).sum::<f32>();
                let least = shown.iter().map(|fit| fit.weighed()).fold(0.0, f32::min);
                let worth = fit + RANK_WEIGHT * rank(number, tree, node, gap);
                let score = expected(number, tree, node, gap);
                found.push((worth, least, GroupCandidate { nodes: vec![(number, node)], score, area }));
            }
        }
        found.sort_by(|(a, _, first), (b, _, second)| b.total_cmp(a).then(first.nodes.cmp(&second.nodes)));
        let fits = found.first().is_some_and(|(_, least, _)| *least >= MIN_BOX_FIT.ln());
        BoxedGroups { groups: apart(found.into_iter().map(|(_, _, group)| group)), fits }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_tree::tree::TREES;
    use crate::scene_tree::{GroupTree, SplatGroup};

    const NO: u32 = NONE;

    /// Leaves 0 and 1, a thing of two halves (4), stand before leaf 2 (with them 5); leaf 3 runs through all of the photo.
    fn scene() -> (SceneTree, LeafMap) {
        let merges = MergeTree {
            leaves: 4,
            parent: vec![4, 4, 5, 6, 5, 6, 6],
            height: vec![0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0],
        };
        let groups = vec![SplatGroup { area: 0.1, cut: 0.5, ..SplatGroup::default() }; 7];
        let trees = vec![GroupTree { merges, groups }; TREES.len()];
        let tree = SceneTree { leaf: vec![0, 1, 2, 3], trees, surfaces: Vec::new(), shown_by: vec![2; 4] };
        #[rustfmt::skip]
        let leaves = vec![
            NO, NO, NO, NO, NO, NO, NO, NO,
            NO, 2,  0,  0,  1,  1,  2,  NO,
            NO, 2,  0,  0,  1,  1,  2,  NO,
            NO, 2,  0,  0,  1,  1,  2,  NO,
            3,  3,  3,  3,  3,  3,  3,  3,
            NO, NO, NO, NO, NO, NO, NO, NO,
        ];
        (tree, LeafMap { width: 8, height: 6, leaves })
    }

    /// What a box from one corner to another means; the photo's own mask has the pixels of some leaves.
    fn found(from: [f32; 2], to: [f32; 2], masked: &[u32]) -> (u32, bool) {
        let (tree, map) = scene();
        let mask = Mask::from_fn(8, 6, |x, y| masked.contains(&map.leaves[(y * 8 + x) as usize]));
        let prompt = BoxPrompt { x0: from[0], y0: from[1], x1: to[0], y1: to[1] };
        let boxes = [BoxedLeaves::of(&map, 4, &prompt, &mask).expect("it shows leaves")];
        let BoxedGroups { groups, fits } = tree.groups_in_boxes(&boxes, TreeBoundaries::All);
        (groups[0].nodes[0].1, fits)
    }

    #[test]
    fn a_box_means_the_group_that_it_goes_around() {
        assert_eq!(found([2.0, 1.0], [6.0, 4.0], &[0, 1]), (4, true));
        assert_eq!(found([2.0, 1.0], [4.0, 4.0], &[0, 1]), (0, true));
        assert_eq!(found([1.0, 1.0], [7.0, 4.0], &[0, 1]), (5, true));
        // Corners in any order; a mask that errs changes nothing.
        assert_eq!(found([6.0, 4.0], [2.0, 1.0], &[0, 1, 2]), (4, true));
    }

    #[test]
    fn a_box_beyond_the_frame_ends_at_it() {
        assert_eq!(found([-9.0, 4.0], [20.0, 5.0], &[3]), (3, true));
    }

    #[test]
    fn a_box_that_no_group_fills_or_that_cuts_through_one_fits_none() {
        // A corner of the thing in much that shows nothing.
        assert!(!found([0.0, 0.0], [8.0, 1.5], &[]).1);
        // A stretch of what runs through all of the photo.
        assert!(!found([0.0, 4.0], [2.0, 5.0], &[3]).1);
    }

    #[test]
    fn a_photo_without_an_own_mask_says_as_much_by_its_box() {
        assert_eq!(found([2.0, 1.0], [6.0, 4.0], &[]), (4, true));
    }

    #[test]
    fn several_boxes_mean_what_shows_in_all_of_them() {
        let (tree, map) = scene();
        let mask = Mask::empty(8, 6);
        let of = |map: &LeafMap, side: f32, x1: f32| {
            let prompt = BoxPrompt { x0: 2.0 * side, y0: side, x1: x1 * side, y1: 4.0 * side };
            BoxedLeaves::of(map, 4, &prompt, &mask)
        };
        // The other photo is twice as large, and shows the left half of the thing alone.
        let leaves = (0..16 * 12).map(|i| map.leaves[i / 32 * 8 + i % 16 / 2]);
        let leaves = leaves.map(|leaf| if leaf == 1 { NO } else { leaf }).collect();
        let other = LeafMap { width: 16, height: 12, leaves };
        let found = |boxes: &[BoxedLeaves]| {
            tree.groups_in_boxes(boxes, TreeBoundaries::All).groups.first().map(|group| group.nodes[0].1)
        };
        let (whole, half) = (of(&map, 1.0, 6.0).unwrap(), of(&other, 2.0, 4.0).unwrap());
        assert_eq!(found(&[half]), Some(0));
        let half = of(&other, 2.0, 4.0).unwrap();
        assert_eq!(found(&[whole, half]), Some(4));
        // A box of nothing.
        let nothing = LeafMap { leaves: vec![NO; map.leaves.len()], ..map };
        assert!(of(&nothing, 1.0, 6.0).is_none());
    }
}
