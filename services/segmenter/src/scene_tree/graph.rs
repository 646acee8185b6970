//! The graph of splats whose distances the views vote on.
//!
//! "IoU by half, half more" of a constant of the scene tree was measured before splats were compared by their gaps.

use super::boundaries::{bounded, depth_edges};
use super::node_surface::{self, FrontSums, NodeSurface};
use super::region_merges::RegionMerges;
use super::sightings::{RegionInView, Sightings};
use super::tree::{CUES, NONE};
use crate::coverage::unoccluded;
use crate::seen_once::ShownCounter;
use crate::{NeighbourGraph, PosedView, SegmentError};
use glam::Vec3;
use rayon::prelude::*;
use segwild_raster::{Channels, CpuEngine, Frame, FrontLayer, NO_SPLAT, ProjectOptions};
use segwild_scene::statistics::median;
use segwild_scene::{Camera, Image, Pose, Splats};
use segwild_vision::ContourTree;

/// Least share of a pixel that a splat must make up for the view to see it there (method, section 13). By choice. IoU by half,
/// half more: +.098, 0 on the demo.
const MIN_FRONT_SHARE: f32 = 0.12;

/// Least share of a splat's light that must reach the camera for the view to see it (method, section 13). By choice. IoU by
/// half, half more: -.006, -.006 on the demo.
const MIN_LIGHT_SHARE: f32 = 0.3;

/// Light in pixels, over all views, from which a splat is a node (method, section 13). By choice. Half and half more changed no
/// measured click.
const MIN_NODE_LIGHT: f32 = 1.0;

/// Opacity from which a splat is a node (method, section 13). By choice. IoU by half, half more: 0, -.006 on the demo.
const MIN_NODE_OPACITY: f32 = 0.1;

/// Nearest neighbours that a splat is linked with (method, section 13). IoU by half, half more: -.016, 0 on the demo.
const NEIGHBOURS: usize = 10;

/// Border pixels between two fronts, over all views, that link their splats (method, section 13). By choice. Half and half more
/// changed no measured click.
const MIN_BORDER: f32 = 3.0;

/// Accumulated alpha `A` under which a pixel has no front (method, section 13). By choice. IoU by half, half more: -.011, 0 on
/// the demo.
const MIN_FRONT_ALPHA: f32 = 0.5;

/// Quantile of the known distances that an edge gets which no view sees (method, section 13). By choice. Half and half more
/// changed no measured click.
const UNSEEN_QUANTILE: f64 = 0.75;

/// Weight of an edge that no view sees, of 1 (method, section 13). By choice. IoU by half, half more: 0, -.007 on the demo.
const UNSEEN_WEIGHT: f32 = 0.2;

/// Weight of the photo's boundaries, and of the gap, in the distance by both (method, section 13). From
/// docs/experiments/2026-11-28-scene-tree.md.
const CUE_WEIGHT: f32 = 0.6;

/// Gap, in sides of the nearer surface ([`NodeSurface::side`]), that is 1 - 1/e of the largest distance (method, section 13). From
/// docs/experiments/2026-11-30-gaps.md.
const GAP_SIDES: f32 = 60.0;

/// Views that see a splat from which on it needs no more of them: the median over so many hardly moves. By choice: no scene on
/// which the tree was measured has more photos. A click visits no more of a scene's photos either.
pub(crate) const ENOUGH_VIEWS: usize = 64;

/// Share of the splats a view sees that must need it, for the view to be added. By choice.
const MIN_NEEDED: f32 = 0.1;

/// Views under which a splat needs more of them urgently, and the share of such splats that is enough for a view to be added. By
/// choice.
const FEW_VIEWS: usize = 8;
const MIN_URGENT: f32 = 0.01;

/// What a view sees of the splats, whatever its photo shows.
pub struct SplatsInView {
    /// The camera at the size of the boundaries.
    camera: Camera,
    pose: Pose,
    front: FrontLayer,
    /// Inverse depth; `None` where the view is not needed.
    inverse: Option<Frame>,
    /// Light in pixels that reaches the view from each splat.
    light: Vec<f32>,
    /// The light that would if nothing stood before the splat.
    unoccluded: Vec<f32>,
    /// Area of a pixel of the size that the scene is trained at, in pixels of this view.
    pixel: f32,
    /// The splats that it sees, ascending.
    seen: Vec<u32>,
}

/// The border between the fronts of two splats, summed over views; in pixel sides.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrontBorder {
    /// One splat, or node.
    pub a: u32,
    /// The other; larger.
    pub b: u32,
    /// Its length.
    pub length: f32,
    /// Its length, weighted by the strength of the depth edge there.
    pub occluding: f32,
    /// The same, positive where `a` is nearer and negative where `b` is.
    pub nearer: f32,
}

impl FrontBorder {
    fn of(from: u32, to: u32, edge: f32, nearer: bool) -> FrontBorder {
        let signed = if nearer { edge } else { -edge };
        let (a, b, nearer) = if from < to { (from, to, signed) } else { (to, from, -signed) };
        FrontBorder { a, b, length: 1.0, occluding: edge, nearer }
    }

    fn add(&mut self, other: &FrontBorder) {
        self.length += other.length;
        self.occluding += other.occluding;
        self.nearer += other.nearer;
    }
}

/// Sorts borders and adds those of one pair.
fn merged(mut borders: Vec<FrontBorder>) -> Vec<FrontBorder> {
    borders.sort_by_key(|border| (border.a, border.b));
    borders.dedup_by(|border, first| {
        let same = (first.a, first.b) == (border.a, border.b);
        if same {
            first.add(border);
        }
        same
    });
    borders
}

/// Collects views. It holds about five bytes per splat and view that sees it, 20 per pair of neighbouring fronts, and about 80
/// per splat.
/// Splats that many views see need no more of them ([`TreeBuilder::needs`]), so that its size does not grow with the
/// photos of a scene.
pub struct TreeBuilder<'a> {
    engine: CpuEngine,
    splats: &'a Splats,
    options: ProjectOptions,
    /// Per view, how the regions of its photo merge.
    views: Vec<RegionMerges>,
    /// Per splat, the views that see it, in the order in which they were added.
    sightings: Sightings,
    /// Light in pixels that the views see of each splat.
    light: Vec<f32>,
    /// Per splat, sides of its fronts on nothing, and on the frame.
    void: Vec<f32>,
    frame: Vec<f32>,
    borders: Vec<FrontBorder>,
    /// Per splat, where its surface lies.
    surfaces: Vec<FrontSums>,
    /// Counts the photos that show each splat.
    shown: ShownCounter,
}

/// An edge between two nodes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplatEdge {
    /// One node.
    pub a: u32,
    /// The other; larger.
    pub b: u32,
    /// By both, by the photo, by the gap, in [0, 1]: the second is the median over the views of the height at which the nodes'
    /// regions merge, the third the gap of their surfaces.
    pub distances: [f32; CUES],
    /// How much it counts: less where no view sees both.
    pub weight: f32,
}

/// Splats as a graph.
#[derive(Clone, Debug, PartialEq)]
pub struct SplatGraph {
    /// Per splat of the scene, its node: its own, or that of the nearest neighbour that has one; [`NONE`] where there is none.
    pub node: Vec<u32>,
    /// Per node, the light in pixels that the views see.
    pub areas: Vec<f32>,
    /// Per node, sides of its fronts next to pixels that show no splat.
    pub void: Vec<f32>,
    /// Per node, sides of its fronts on a photo's frame.
    pub frame: Vec<f32>,
    /// Edges between nodes, in order, each once.
    pub edges: Vec<SplatEdge>,
    /// Borders between the nodes' fronts, in order, each pair once.
    pub borders: Vec<FrontBorder>,
    /// Per node, the surface that the views show of it; `None` where none does.
    pub(super) surfaces: Vec<Option<NodeSurface>>,
}

impl<'a> TreeBuilder<'a> {
    /// The order in which views are best offered, of so many: photos of one walk follow one another by name, so that many of them
    /// are taken in wide steps, and the first already see the scene from everywhere.
    pub fn order(views: usize) -> Vec<usize> {
        if views <= ENOUGH_VIEWS {
            return (0..views).collect();
        }
        let shares_no_factor =
            |step: &usize| !(2..=*step).any(|d| step.is_multiple_of(d) && views.is_multiple_of(d));
        // The golden section of the list: no short round of such steps comes back to where it began.
        let step = (views * 618 / 1000..).find(shares_no_factor).expect("one of them is prime");
        (0..views).map(|i| i * step % views).collect()
    }

    /// Without views yet.
    pub fn new(splats: &'a Splats, options: ProjectOptions) -> TreeBuilder<'a> {
        TreeBuilder {
            engine: CpuEngine::new(),
            splats,
            options,
            views: Vec::new(),
            sightings: Sightings::new(splats.len()),
            light: vec![0.0; splats.len()],
            void: vec![0.0; splats.len()],
            frame: vec![0.0; splats.len()],
            borders: Vec::new(),
            surfaces: vec![FrontSums::default(); splats.len()],
            shown: ShownCounter::new(splats.len()),
        }
    }

    /// What a view sees of the splats, at the size of its boundaries in pixels. Its camera has the size that the scene is trained at.
    ///
    /// # Errors
    /// When it cannot be rendered.
    pub fn see(&self, view: &PosedView, width: usize, height: usize) -> Result<SplatsInView, SegmentError> {
        let camera = view.camera.resized(width as u32, height as u32);
        let raster = || SegmentError::raster(&view.name);
        let (splats, options) = (self.splats, &self.options);
        let (projected, front) =
            self.engine.project_with_front(splats, &camera, &view.pose, options).map_err(raster())?;
        let light = projected.gather(&Image::filled(width, height, 1, 1.0)).map_err(raster())?;
        let unoccluded = unoccluded(splats, &camera, &view.pose, options);
        let sees =
            |&i: &usize| front.shares[i] > MIN_FRONT_SHARE && light[i] > MIN_LIGHT_SHARE * unoccluded[i];
        let seen: Vec<u32> = (0..splats.len()).filter(sees).map(|i| i as u32).collect();
        // Of a thousand photos most are not needed.
        let inverse = match self.is_needed(&seen) {
            true => {
                let depths = projected.depths().iter();
                let values: Vec<f32> = depths.map(|&z| if z > 0.0 { 1.0 / z } else { 0.0 }).collect();
                Some(projected.blend(&Channels { count: 1, values: &values }).map_err(raster())?)
            }
            false => None,
        };
        let trained = view.camera.width as f32 * view.camera.height as f32;
        let pixel = (width * height) as f32 / trained;
        Ok(SplatsInView { camera, pose: view.pose, front, inverse, light, unoccluded, pixel, seen })
    }

    /// Whether enough of the splats that a view sees were seen by few of the views that had been added when it was
    /// rendered.
    pub fn needs(&self, view: &SplatsInView) -> bool {
        view.inverse.is_some()
    }

    fn is_needed(&self, seen: &[u32]) -> bool {
        let fewer = |views: usize| {
            let known = |&&i: &&u32| self.sightings.count(i as usize) < views;
            seen.iter().filter(known).count() as f32 / seen.len().max(1) as f32
        };
        fewer(ENOUGH_VIEWS) >= MIN_NEEDED || fewer(FEW_VIEWS) >= MIN_URGENT
    }

    /// Counts the splats that a view shows, for [`SceneTree::shown_by`](super::SceneTree::shown_by). A view that is not needed takes
    /// part in nothing else; one that is added is counted with it.
    pub fn count(&mut self, view: &SplatsInView) {
        self.shown.add(&view.light, &view.unoccluded, view.pixel);
    }

    /// Per splat, the photos that show it.
    pub(super) fn shown_by(&self) -> Vec<u16> {
        self.shown.counts()
    }

    /// Adds a view with the boundaries of its photo: one plane of strengths in [0, 1]. A view that is not needed is only
    /// counted. A view with more than 65,535 regions says nothing of its splats, nor does any after so many views.
    pub fn add(&mut self, view: SplatsInView, photo: &Image) {
        self.count(&view);
        let SplatsInView { camera, pose, front, inverse: Some(inverse), light, seen, .. } = view else {
            return;
        };
        let edges = depth_edges(&inverse);
        let regions = ContourTree::of(&bounded(photo));
        if let (Some(merges), Ok(number)) =
            (RegionMerges::of(&regions.merges), u16::try_from(self.views.len()))
        {
            for &i in &seen {
                let region = regions.labels[front.pixels[i as usize] as usize] as u16;
                self.sightings.add(i as usize, RegionInView { view: number, region });
            }
            self.views.push(merges);
        }
        for &i in &seen {
            self.light[i as usize] += light[i as usize];
        }
        let depths: Vec<f32> = (0..front.splats.len()).map(|i| depth(&front, &inverse.image, i)).collect();
        node_surface::add_view(&mut self.surfaces, &front.splats, &depths, &camera, &pose);
        self.add_borders(&front, &inverse.image, &edges);
    }

    /// Adds the sides of the fronts of a view.
    fn add_borders(&mut self, front: &FrontLayer, inverse: &Image, edges: &Image) {
        let (w, h) = (front.width, front.height);
        let solid = |i: usize| is_solid(front, i);
        let near = |i: usize| inverse.data[i] / front.alpha.data[i];
        let mut borders = std::mem::take(&mut self.borders);
        for i in 0..w * h {
            let (x, y) = (i % w, i / w);
            let splat = front.splats[i] as usize;
            if solid(i) {
                let sides = [x == 0, x + 1 == w, y == 0, y + 1 == h];
                self.frame[splat] += sides.iter().filter(|side| **side).count() as f32;
            }
            for j in [(x + 1 < w).then_some(i + 1), (y + 1 < h).then_some(i + w)].into_iter().flatten() {
                match (solid(i), solid(j)) {
                    (true, true) if front.splats[i] != front.splats[j] => {
                        let edge = edges.data[i].max(edges.data[j]);
                        borders.push(FrontBorder::of(
                            front.splats[i],
                            front.splats[j],
                            edge,
                            near(i) > near(j),
                        ));
                    }
                    (true, false) => self.void[splat] += 1.0,
                    (false, true) => self.void[front.splats[j] as usize] += 1.0,
                    _ => {}
                }
            }
        }
        self.borders = merged(borders);
    }

    /// Per node, the surface that the views show of its splats. `node`: that of each splat.
    fn surfaces(&self, node: &[u32], nodes: usize) -> Vec<Option<NodeSurface>> {
        let mut sums = vec![FrontSums::default(); nodes];
        for (of, &node) in self.surfaces.iter().zip(node).filter(|(_, node)| **node != NONE) {
            sums[node as usize] = sums[node as usize].and(*of);
        }
        sums.iter().map(NodeSurface::of).collect()
    }

    /// The graph of all splats that some view sees.
    pub fn graph(&self) -> SplatGraph {
        let takes_part =
            |i: &usize| self.light[*i] > MIN_NODE_LIGHT && self.splats.opacity(*i) > MIN_NODE_OPACITY;
        let parts: Vec<u32> = (0..self.splats.len()).filter(takes_part).map(|i| i as u32).collect();
        let mut node = vec![NONE; self.splats.len()];
        parts.iter().enumerate().for_each(|(k, &i)| node[i as usize] = k as u32);
        let node = followers(node, &NeighbourGraph::new(self.splats, NEIGHBOURS));
        let points: Vec<[f32; 3]> = parts.iter().map(|&i| self.splats.means[i as usize]).collect();
        let near = NeighbourGraph::of_points(&points, NEIGHBOURS);
        let mut pairs: Vec<(u32, u32)> = (0..points.len())
            .flat_map(|a| near.edges(a).map(move |e| (a, e)))
            .map(|(a, e)| (a as u32, near.neighbour(e) as u32))
            .filter(|(a, b)| a < b)
            .collect();
        drop(near);
        let of_nodes = self.borders.iter().filter_map(|border| {
            let (a, b) = (node[border.a as usize], node[border.b as usize]);
            match a == NONE || b == NONE || a == b {
                true => None,
                false if a < b => Some(FrontBorder { a, b, ..*border }),
                false => Some(FrontBorder { a: b, b: a, nearer: -border.nearer, ..*border }),
            }
        });
        let borders = merged(of_nodes.collect());
        pairs.extend(
            borders.iter().filter(|border| border.length >= MIN_BORDER).map(|border| (border.a, border.b)),
        );
        pairs.sort_unstable();
        pairs.dedup();
        let surfaces = self.surfaces(&node, parts.len());
        let gap = |&(a, b): &(u32, u32)| {
            let ends = [a, b].map(|k| k as usize);
            let side = ends.iter().filter_map(|&k| Some(surfaces[k]?.side)).reduce(f32::min)?;
            let [from, to] = ends.map(|k| surfaces[k].map_or(Vec3::from(points[k]), |surface| surface.point));
            Some(1.0 - (-from.distance(to) / (GAP_SIDES * side)).exp())
        };
        let photo = |&(a, b): &(u32, u32)| self.distance(parts[a as usize], parts[b as usize]);
        let mut gaps: Vec<Option<f32>> = pairs.par_iter().map(gap).collect();
        let mut photos: Vec<Option<f32>> = pairs.par_iter().map(photo).collect();
        // An edge that no view sees gets a distance when all others are known.
        let is_seen: Vec<bool> = photos.iter().map(Option::is_some).collect();
        for of in [&mut gaps, &mut photos] {
            let fill = quantile(of.iter().flatten().copied().collect(), UNSEEN_QUANTILE);
            of.iter_mut().for_each(|distance| *distance = distance.or(Some(fill)));
        }
        let edge = |(i, &(a, b)): (usize, &(u32, u32))| {
            let (photo, gap) = (photos[i].unwrap_or_default(), gaps[i].unwrap_or_default());
            let both = (CUE_WEIGHT * (photo + gap)).min(1.0);
            SplatEdge {
                a,
                b,
                distances: [both, photo, gap],
                weight: if is_seen[i] { 1.0 } else { UNSEEN_WEIGHT },
            }
        };
        let edges: Vec<SplatEdge> = pairs.iter().enumerate().map(edge).collect();
        drop((pairs, gaps, photos));
        let sum = |of: &[f32]| {
            let mut sums = vec![0.0; parts.len()];
            of.iter().zip(&node).filter(|(_, n)| **n != NONE).for_each(|(x, n)| sums[*n as usize] += x);
            sums
        };
        let (areas, void, frame) = (sum(&self.light), sum(&self.void), sum(&self.frame));
        SplatGraph { areas, void, frame, edges, borders, surfaces, node }
    }

    /// The median over the views that see both splats of the height at which their regions merge.
    fn distance(&self, a: u32, b: u32) -> Option<f32> {
        let mut heights = Vec::new();
        // Both go back through the views.
        let mut others = self.sightings.latest_first(b as usize).peekable();
        for at in self.sightings.latest_first(a as usize) {
            while others.next_if(|other| other.view > at.view).is_some() {}
            let Some(other) = others.next_if(|other| other.view == at.view) else { continue };
            heights.push(self.views[usize::from(at.view)].height(at.region, other.region));
        }
        median(heights)
    }
}

/// Whether a pixel has a front.
fn is_solid(front: &FrontLayer, pixel: usize) -> bool {
    front.alpha.data[pixel] >= MIN_FRONT_ALPHA && front.splats[pixel] != NO_SPLAT
}

/// Depth of a pixel's front by the blend of inverse depths; 0 where it has none.
fn depth(front: &FrontLayer, inverse: &Image, pixel: usize) -> f32 {
    let depth = front.alpha.data[pixel] / inverse.data[pixel];
    if is_solid(front, pixel) && depth.is_finite() { depth } else { 0.0 }
}

/// Splats that take no part follow the nearest neighbour that has a node.
fn followers(mut node: Vec<u32>, neighbours: &NeighbourGraph) -> Vec<u32> {
    let mut open: Vec<usize> = (0..node.len()).filter(|&i| node[i] == NONE).collect();
    loop {
        let found: Vec<(usize, u32)> = open
            .par_iter()
            .filter_map(|&i| {
                let near = neighbours.edges(i).filter(|&e| node[neighbours.neighbour(e)] != NONE);
                let nearest =
                    near.min_by(|&a, &b| neighbours.distance(a).total_cmp(&neighbours.distance(b)))?;
                Some((i, node[neighbours.neighbour(nearest)]))
            })
            .collect();
        if found.is_empty() {
            return node;
        }
        found.iter().for_each(|&(i, of)| node[i] = of);
        open.retain(|&i| node[i] == NONE);
    }
}

/// A quantile of numbers by the nearest rank; 0 of none. The rank is computed in f64: there may be more edges than an f32 counts.
pub(super) fn quantile(mut of: Vec<f32>, share: f64) -> f32 {
    let at = (of.len().saturating_sub(1) as f64 * share).round() as usize;
    if of.is_empty() { 0.0 } else { *of.select_nth_unstable_by(at, f32::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_offered_once_each_and_many_of_them_spread_over_the_list() {
        for views in [0, 1, 64, 65, 66, 100, 1000, 1009] {
            let mut order = TreeBuilder::order(views);
            if views > ENOUGH_VIEWS {
                let mut first = order[..20].to_vec();
                first.sort_unstable();
                assert!(first.windows(2).all(|pair| pair[1] - pair[0] <= views / 8), "{views}: {first:?}");
            }
            order.sort_unstable();
            assert!(order.into_iter().eq(0..views), "{views}");
        }
    }
}
