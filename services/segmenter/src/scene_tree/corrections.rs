//! Corrections of a group by further clicks (method, section 13): each adds or takes out the part that it hits, and changes
//! nothing else.

use super::query::{SURFACE_IOU, expected};
use super::{GroupCandidate, NONE, SceneTree};
use crate::{PosedView, TreeBoundaries};
use glam::Vec2;
use segwild_raster::{CpuEngine, ProjectOptions, RasterError};
use segwild_scene::{Mask, Splats};

/// Share of a part's light that must lie on the side that a click corrects: inside of what has too much, outside of what
/// lacks it (method, section 13). By choice.
const MIN_WRONG_SHARE: f32 = 0.7;

/// Largest part that a click adds, as a share of the selection's light (method, section 13). From
/// docs/experiments/2026-11-30-corrections.md.
const MAX_ADDED: f32 = 0.5;

/// A part of this share of all light may be added to any selection (method, section 13): a small one would hardly grow otherwise.
/// From docs/experiments/2026-11-30-corrections.md.
const SMALL_SELECTION_ADDED: f32 = 0.05;

/// Largest part that a click takes out, as a share of the selection's light (method, section 13). From
/// docs/experiments/2026-11-30-corrections.md.
const MAX_TAKEN_OUT: f32 = 0.25;

/// Largest part of a surface that a click adds or takes out, as a share of the selection's light (method, section 13): it is found by
/// its shape, and hardly ends too early. By choice.
const MAX_OF_SURFACE: f32 = 0.5;

/// Weight of how deep a click lies within a part, beside the part's expected IoU (method, section 13): a person clicks into the
/// middle of what is wrong. From docs/experiments/2026-11-30-corrections.md.
const DEPTH_WEIGHT: f32 = 1.0;

/// Long side in pixels at which that depth is measured.
const DEPTH_SIZE: u32 = 128;

/// Accumulated alpha `A` under which a pixel shows nothing. By choice.
const MIN_SHOWN_ALPHA: f32 = 0.5;

/// A click on the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct LeafClick {
    /// The leaf that it hits.
    pub leaf: u32,
    /// The surface that it hits, by its number; `None` where it hits none.
    pub surface: Option<usize>,
    /// Whether it is meant.
    pub inside: bool,
    /// What its photo shows; `None` where it is the only click.
    pub shown: Option<ShownLeaves>,
}

/// The leaves that a photo shows, and the pixel of a click.
#[derive(Clone, Debug, PartialEq)]
pub struct ShownLeaves {
    width: u32,
    height: u32,
    /// Per pixel, row by row, the leaf of the splat that makes up most of it; [`NONE`] where there is none.
    leaves: Vec<u32>,
    clicked: (u32, u32),
}

impl ShownLeaves {
    /// What a view shows, for a click on a pixel of it.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn of(
        engine: &CpuEngine,
        tree: &SceneTree,
        splats: &Splats,
        options: &ProjectOptions,
        view: &PosedView,
        click: Vec2,
    ) -> Result<ShownLeaves, RasterError> {
        let camera = view.camera.scaled_to(DEPTH_SIZE);
        let front = engine.front(splats, &camera, &view.pose, options)?;
        let leaf = |(&splat, &alpha): (&u32, &f32)| match tree.leaf.get(splat as usize) {
            Some(&leaf) if alpha >= MIN_SHOWN_ALPHA => leaf,
            _ => NONE,
        };
        let leaves = front.splats.iter().zip(&front.alpha.data).map(leaf).collect();
        let scale = camera.width as f32 / view.camera.width as f32;
        let at = |v: f32, side: u32| ((v * scale).max(0.0) as u32).min(side - 1);
        let clicked = (at(click.x, camera.width), at(click.y, camera.height));
        Ok(ShownLeaves { width: camera.width, height: camera.height, leaves, clicked })
    }

    /// The pixels that show some leaves.
    fn mask(&self, part: &[bool]) -> Mask {
        Mask::from_fn(self.width, self.height, |x, y| {
            let leaf = self.leaves[(y * self.width + x) as usize];
            leaf != NONE && part[leaf as usize]
        })
    }

    /// How deep the click lies within some leaves: 0 outside of them, 1 where they are deepest.
    fn depth(&self, part: &[bool]) -> f32 {
        let depths = self.mask(part).depths();
        let most = depths.iter().copied().fold(0.0, f32::max);
        let (x, y) = self.clicked;
        if most > 0.0 { depths[(y * self.width + x) as usize] / most } else { 0.0 }
    }
}

/// A selection of leaves, and which of them clicks corrected.
#[derive(Clone, Debug, PartialEq)]
pub struct CorrectedLeaves {
    /// Per leaf, whether it is selected.
    pub selected: Vec<bool>,
    /// Per leaf, whether a click decided it.
    pub decided: Vec<bool>,
}

impl CorrectedLeaves {
    /// A selection that no click corrects.
    pub fn uncorrected(selected: Vec<bool>) -> CorrectedLeaves {
        CorrectedLeaves { decided: vec![false; selected.len()], selected }
    }
}

impl SceneTree {
    /// The group that a click hits and that its photo shows most like a mask; `None` where none shows there.
    pub fn most_alike(
        &self,
        click: &LeafClick,
        mask: &Mask,
        boundaries: TreeBoundaries,
    ) -> Option<GroupCandidate> {
        let shown = click.shown.as_ref()?;
        let mask = mask.resized(shown.width, shown.height);
        let alike = |group: GroupCandidate| {
            let iou = shown.mask(&self.leaves_of(&group)).iou(&mask);
            (iou > 0.0).then_some((iou, group))
        };
        let groups = self.groups_with(click.leaf, boundaries).into_iter().filter_map(alike);
        groups.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, group)| group)
    }

    /// Corrects a selection of leaves by clicks, one after the other. No part contradicts any of them, nor `first`: the click that
    /// chose the selection, which corrects nothing.
    pub fn corrected(
        &self,
        selected: Vec<bool>,
        first: Option<&LeafClick>,
        clicks: &[LeafClick],
    ) -> CorrectedLeaves {
        let mut now = CorrectedLeaves::uncorrected(selected);
        let all: Vec<&LeafClick> = first.into_iter().chain(clicks).collect();
        for click in clicks {
            let part = self.part_at(&now.selected, click, &all);
            for (leaf, _) in part.iter().enumerate().filter(|(_, inside)| **inside) {
                now.selected[leaf] = click.inside;
                now.decided[leaf] = true;
            }
        }
        now
    }

    /// The part that a click means: of the groups that hold it, no click of the other kind and mostly what is wrong, and of what is
    /// wrong on the surface that it hits, the one that is likely a thing and has the click in its middle. Where nothing is wrong
    /// there, or nothing is such a part, the smallest group.
    fn part_at(&self, selected: &[bool], click: &LeafClick, clicks: &[&LeafClick]) -> Vec<bool> {
        let leaves = selected.len();
        let is_wrong = |leaf: usize| selected[leaf] != click.inside;
        let light_of = |takes_part: &dyn Fn(usize) -> bool| -> Vec<f32> {
            let light = self.leaf_light().enumerate();
            light.map(|(leaf, light)| if takes_part(leaf) { light } else { 0.0 }).collect()
        };
        let selection = light_of(&|leaf| selected[leaf]).iter().sum::<f32>();
        let most = match click.inside {
            true => (MAX_ADDED * selection).max(SMALL_SELECTION_ADDED),
            false => MAX_TAKEN_OUT * selection,
        };
        let wrong_light = light_of(&is_wrong);
        let depth_of = |part: &[bool]| click.shown.as_ref().map_or(0.0, |shown| shown.depth(part));
        let (mut best, mut smallest) = (None::<(f32, usize, u32)>, None::<(f32, usize, u32)>);
        for (number, tree) in self.trees.iter().enumerate() {
            let merges = &tree.merges;
            let area = |node: u32| tree.groups[node as usize].area;
            let wrong = merges.sums(&wrong_light);
            let others = clicks.iter().filter(|other| other.inside != click.inside);
            let against = others.map(|other| merges.meet(click.leaf, other.leaf)).min();
            let groups = tree.large_groups_with(click.leaf);
            for (node, gap) in groups.take_while(|(node, _)| against.is_none_or(|against| *node < against)) {
                if smallest.is_none_or(|(least, ..)| area(node) < least) {
                    smallest = Some((area(node), number, node));
                }
                let is_part =
                    wrong[node as usize] as f32 >= MIN_WRONG_SHARE * area(node) && area(node) <= most;
                if !is_wrong(click.leaf as usize) || !is_part {
                    continue;
                }
                let candidate = merges.parts_of(node);
                let within: Vec<bool> = (0..leaves).map(|leaf| candidate[leaf] && is_wrong(leaf)).collect();
                let score = expected(number, tree, node, gap) + DEPTH_WEIGHT * depth_of(&within);
                if best.is_none_or(|(most, ..)| score > most) {
                    best = Some((score, number, node));
                }
            }
        }
        // What came along of a surface goes with one click, however little of the surface that is.
        if let Some(surface) = click.surface.map(|number| &self.surfaces[number]) {
            let within: Vec<bool> =
                self.leaves_on(surface).iter().enumerate().map(|(leaf, &on)| on && is_wrong(leaf)).collect();
            let light: f32 = within.iter().zip(&wrong_light).filter(|(on, _)| **on).map(|(_, l)| l).sum();
            let mut others = clicks.iter().filter(|other| other.inside != click.inside);
            let score = SURFACE_IOU + DEPTH_WEIGHT * depth_of(&within);
            let is_part = within[click.leaf as usize]
                && light <= MAX_OF_SURFACE * selection
                && others.all(|other| !within[other.leaf as usize]);
            if is_part && best.is_none_or(|(most, ..)| score > most) {
                return within;
            }
        }
        match best.or(smallest) {
            Some((_, number, node)) => {
                let mut part = self.trees[number].merges.parts_of(node);
                part.truncate(leaves);
                part
            }
            None => (0..leaves).map(|leaf| leaf == click.leaf as usize).collect(),
        }
    }
}
