//! The parts of a scene: groups of the scene tree that do not overlap, without a click.

use super::front_values::front_values;
use super::query::{MAX_PART_AREA, MIN_AREA, expected};
use super::{GroupCandidate, GroupTree, NONE, SceneTree};
use crate::PosedView;
use crate::seen_once::leave_out_of_parts;
use segwild_raster::{CpuEngine, ProjectOptions, RasterError};
use segwild_scene::{Mask, Splats};

/// Parts that a scene is listed as, at most: file formats hold their numbers as bytes.
pub const MOST_PARTS: usize = 99;

/// Share of a group that likelier parts may hold (method, section 13); what they hold is theirs. By choice; for the list alone.
const MAX_SHARED: f32 = 0.1;

/// Least expected IoU of a part with a thing (method, section 13). By choice; for the list alone.
const MIN_EXPECTED_IOU: f32 = 0.25;

/// The parts of a scene, the likeliest things first. They are numbered from 1.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneParts {
    /// The group of each part.
    pub groups: Vec<GroupCandidate>,
    /// Per splat of the scene, the number of its part; 0 where it belongs to none.
    pub labels: Vec<u8>,
    /// Whether one photo alone shows each splat of the scene; empty where that is not known.
    pub seen_once: Vec<bool>,
}

impl SceneParts {
    /// Whether each splat belongs to the part of this number.
    pub fn holds(&self, number: usize) -> Vec<bool> {
        self.labels.iter().map(|&label| usize::from(label) == number).collect()
    }
}

/// The part that each pixel of a view shows.
#[derive(Clone, Debug, PartialEq)]
pub struct PartMap {
    /// Pixels of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Per pixel, row by row, the number of the part; 0 where it shows none.
    pub labels: Vec<u8>,
    /// Pixels most of which is made up by a splat that one photo alone shows.
    pub seen_once: usize,
}

impl PartMap {
    /// Renders the parts into a view: a pixel shows the part of the splat that makes up most of it.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn render(
        engine: &CpuEngine,
        splats: &Splats,
        options: &ProjectOptions,
        view: &PosedView,
        parts: &SceneParts,
    ) -> Result<PartMap, RasterError> {
        let of_splat = |splat: Option<usize>| {
            let label = splat.and_then(|splat| parts.labels.get(splat)).copied().unwrap_or(0);
            (label, splat.and_then(|splat| parts.seen_once.get(splat)) == Some(&true))
        };
        let front = front_values(engine, splats, options, view, of_splat)?;
        Ok(PartMap {
            width: front.width,
            height: front.height,
            seen_once: front.values.iter().filter(|(_, once)| *once).count(),
            labels: front.values.into_iter().map(|(label, _)| label).collect(),
        })
    }

    /// By number, the pixels that show each part.
    pub fn counts(&self) -> Vec<u32> {
        let mut counts = vec![0; usize::from(u8::MAX) + 1];
        self.labels.iter().for_each(|&label| counts[usize::from(label)] += 1);
        counts
    }

    /// By number, the pixels on the frame that show each part.
    pub fn counts_on_frame(&self) -> Vec<u32> {
        let mut counts = vec![0; usize::from(u8::MAX) + 1];
        for y in 0..self.height {
            let inner = y > 0 && y + 1 < self.height;
            for x in (0..self.width).filter(|&x| !inner || x == 0 || x + 1 == self.width) {
                counts[usize::from(self.labels[y * self.width + x])] += 1;
            }
        }
        counts
    }

    /// The pixels that show a part.
    pub fn mask(&self, number: u8) -> Mask {
        let label = |x: u32, y: u32| self.labels[y as usize * self.width + x as usize];
        Mask::from_fn(self.width as u32, self.height as u32, |x, y| label(x, y) == number)
    }

    /// The same at another size: where it grows, its outline is that of the share of the part, linear between pixel centres.
    pub fn enlarged(&self, number: u8, width: u32, height: u32) -> Mask {
        let (mut low, mut high) = ([usize::MAX; 2], [0usize; 2]);
        for (i, _) in self.labels.iter().enumerate().filter(|(_, label)| **label == number) {
            let at = [i % self.width, i / self.width];
            low = [0, 1].map(|k| low[k].min(at[k]));
            high = [0, 1].map(|k| high[k].max(at[k]));
        }
        let small = [self.width, self.height];
        let share = |at: [f32; 2]| {
            let mut share = 0.0;
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let step = [dx, dy];
                let [column, row] = [0, 1]
                    .map(|k| (at[k].floor() as isize + step[k]).clamp(0, small[k] as isize - 1) as usize);
                let near = |k: usize| if step[k] == 0 { 1.0 - at[k].fract() } else { at[k].fract() };
                if self.labels[row * self.width + column] == number {
                    share += near(0) * near(1);
                }
            }
            share
        };
        Mask::from_fn(width, height, |x, y| {
            let at = |v: u32, full: u32, small: usize| {
                ((v as f32 + 0.5) * small as f32 / full as f32 - 0.5).max(0.0)
            };
            let at = [at(x, width, small[0]), at(y, height, small[1])];
            // Most pixels are far from it.
            let near =
                |k: usize| low[k] <= high[k] && at[k] + 1.0 >= low[k] as f32 && at[k] <= high[k] as f32 + 1.0;
            near(0) && near(1) && share(at) > 0.5
        })
    }
}

impl SceneTree {
    /// Lists the scene's parts: groups by their expected IoU with a thing, each without what likelier ones hold, and without what one
    /// photo alone shows where others show the part.
    pub fn parts(&self) -> SceneParts {
        let mut found: Vec<GroupCandidate> =
            self.trees.iter().enumerate().flat_map(|(number, tree)| likely(number, tree)).collect();
        found.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.nodes.cmp(&b.nodes)));
        let leaves = self.leaf_count();
        let area: Vec<f32> = self.leaf_light().collect();
        let mut part_of = vec![0u8; leaves];
        let mut groups = Vec::new();
        // Per tree and node, the area that parts hold.
        let mut held: Vec<Vec<f64>> = self.trees.iter().map(|tree| vec![0.0; tree.merges.len()]).collect();
        for group in found {
            if groups.len() == MOST_PARTS {
                break;
            }
            let (tree, node) = group.nodes[0];
            if held[tree][node as usize] > f64::from(MAX_SHARED * group.area) {
                continue;
            }
            let number = groups.len() as u8 + 1;
            let inside = self.trees[tree].merges.parts_of(node);
            for (part, _) in part_of.iter_mut().zip(&inside).filter(|(part, inside)| **part == 0 && **inside)
            {
                *part = number;
            }
            let of_leaf: Vec<f32> =
                part_of.iter().zip(&area).map(|(&part, &area)| if part > 0 { area } else { 0.0 }).collect();
            for (held, tree) in held.iter_mut().zip(&self.trees) {
                *held = tree.merges.sums(&of_leaf);
            }
            groups.push(group);
        }
        let part = |&leaf: &u32| if leaf == NONE { 0 } else { part_of[leaf as usize] };
        let mut labels: Vec<u8> = self.leaf.iter().map(part).collect();
        let seen_once = self.seen_once();
        leave_out_of_parts(&mut labels, &seen_once);
        SceneParts { groups, labels, seen_once }
    }
}

/// The groups of a tree that may be parts.
fn likely(number: usize, tree: &GroupTree) -> impl Iterator<Item = GroupCandidate> + '_ {
    let may_be_part = |area: f32| (MIN_AREA..=MAX_PART_AREA).contains(&area);
    let gaps = tree.relative_gaps();
    (0..gaps.len()).filter(move |&node| may_be_part(tree.groups[node].area)).filter_map(move |node| {
        let score = expected(number, tree, node as u32, gaps[node]);
        let area = tree.groups[node].area;
        (score >= MIN_EXPECTED_IOU).then(|| GroupCandidate {
            nodes: vec![(number, node as u32)],
            score,
            area,
        })
    })
}
