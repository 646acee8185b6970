//! The neighbour graph of the splats and its connected parts (method, section 6).

use crate::SplatFeatures;
use glam::Vec3;
use rayon::prelude::*;
use segwild_scene::Splats;
use segwild_scene::knn::{self, NONE};
use std::sync::OnceLock;

/// Two splats further apart than this many times the smaller of their local spacings are not linked, unless their ellipsoids
/// meet (method, section 6.5): a floater does not connect two objects. By choice. IoU by half, half more: 0, 0 on
/// `sacre_coeur`; +.007, 0 on the demo.
const LINK_SPACINGS: f32 = 3.0;

/// Standard deviations at which two ellipsoids count as meeting (method, section 6.5). By choice. Half and half more changed no
/// measured click.
const MEETING_DEVIATIONS: f32 = 2.0;

/// Colour distance `sigma_c` (sRGB) at which an edge has lost 40 % of its weight (method, section 6.3). By choice. IoU by half,
/// half more: 0, 0 on `sacre_coeur`; +.001, 0 on the demo.
const COLOUR_SIGMA: f32 = 0.25;

/// How fast `kappa_f` an edge's weight falls with the angle between two features (method, section 6.3): `exp(kappa_f (cos -
/// 1))`. By choice. IoU by half, half more: 0, 0 on `sacre_coeur`; +.002, 0 on the demo.
const FEATURE_STEEPNESS: f32 = 4.0;

/// Nearest neighbours of a splat, at most.
pub(crate) const MOST_NEIGHBOURS: usize = 256;

/// The constant spherical harmonic. It is one unit in the last place above [`segwild_scene::ply::SH0`], so that selections
/// keep their bytes.
const SH0: f32 = 0.282_094_8;

/// Undirected neighbour graph, as compressed rows: the edges of splat `i` are
/// `offsets[i]..offsets[i + 1]`, its neighbours ascending. Each edge occurs in both rows.
#[derive(Clone, Debug, PartialEq)]
pub struct NeighbourGraph {
    /// How many nearest neighbours each splat was linked with.
    nearest: usize,
    offsets: Vec<u32>,
    neighbours: Vec<u32>,
    distances: Vec<f32>,
    /// Distance to the furthest of the nearest neighbours: the local spacing.
    spacing: Vec<f32>,
}

/// The affinities of a scene's graph. They depend on the scene alone, so that the first selection computes them for all that
/// follow.
#[derive(Debug, Default)]
pub struct SceneAffinities {
    /// Without features, and with them.
    computed: [OnceLock<Vec<f32>>; 2],
}

impl SceneAffinities {
    /// [`NeighbourGraph::affinities`], computed where they are not known yet. All calls are about one graph, its splats and one
    /// field.
    pub(crate) fn of(
        &self,
        graph: &NeighbourGraph,
        splats: &Splats,
        field: Option<&SplatFeatures>,
    ) -> &[f32] {
        let known = &self.computed[usize::from(field.is_some())];
        if let Some(known) = known.get() {
            return known;
        }
        let computed = graph.affinities(splats, field);
        known.get_or_init(|| computed)
    }
}

/// The neighbour graph of a scene with its affinities, kept from selection to selection.
#[derive(Debug, Default)]
pub struct SceneGraph {
    /// `None` before the first selection.
    graph: Option<NeighbourGraph>,
    affinities: SceneAffinities,
}

impl SceneGraph {
    /// Links every splat with its `k` nearest.
    pub fn new(splats: &Splats, k: usize) -> SceneGraph {
        SceneGraph { graph: Some(NeighbourGraph::new(splats, k)), affinities: SceneAffinities::default() }
    }

    /// Whether it links the splats of such a scene with their `k` nearest: another setting needs another graph.
    pub fn fits(&self, splats: &Splats, k: usize) -> bool {
        self.graph.as_ref().is_some_and(|graph| graph.len() == splats.len() && graph.nearest == k)
    }

    /// The graph, if it is made.
    pub fn graph(&self) -> Option<&NeighbourGraph> {
        self.graph.as_ref()
    }

    /// The affinities of its edges, as far as selections needed them.
    pub fn affinities(&self) -> &SceneAffinities {
        &self.affinities
    }

    /// Computes the affinities before a selection needs them.
    pub(crate) fn compare(&self, splats: &Splats, field: Option<&SplatFeatures>) {
        if let Some(graph) = &self.graph {
            self.affinities.of(graph, splats, field);
        }
    }
}

impl NeighbourGraph {
    /// Links every splat with its `k` nearest, in either direction. Splats whose centre is not finite stay alone.
    pub fn new(splats: &Splats, k: usize) -> NeighbourGraph {
        NeighbourGraph::of_points(&splats.means, k)
    }

    /// The same over bare points.
    pub fn of_points(points: &[[f32; 3]], k: usize) -> NeighbourGraph {
        let nearest = knn::nearest(points, k);
        let n = points.len();
        // Count, fill, then sort each row and drop the edges that both ends named.
        let mut counts = vec![0u32; n + 1];
        let directed = || {
            (0..n).flat_map(|i| {
                let row = i * k..(i + 1) * k;
                nearest.index[row.clone()]
                    .iter()
                    .zip(&nearest.distance2[row])
                    .filter(|(j, _)| **j != NONE)
                    .map(move |(&j, &d)| (i as u32, j, d))
            })
        };
        for (i, j, _) in directed() {
            counts[i as usize + 1] += 1;
            counts[j as usize + 1] += 1;
        }
        for i in 0..n {
            counts[i + 1] += counts[i];
        }
        let mut cursor = counts.clone();
        let mut edges = vec![(0u32, 0f32); counts[n] as usize];
        for (i, j, d) in directed() {
            for (from, to) in [(i, j), (j, i)] {
                edges[cursor[from as usize] as usize] = (to, d.sqrt());
                cursor[from as usize] += 1;
            }
        }
        let mut graph = NeighbourGraph {
            nearest: k,
            offsets: Vec::with_capacity(n + 1),
            neighbours: Vec::with_capacity(edges.len()),
            distances: Vec::with_capacity(edges.len()),
            spacing: (0..n)
                .map(|i| {
                    let row = &nearest.distance2[i * k..(i + 1) * k];
                    row.iter().rev().find(|d| d.is_finite()).map_or(0.0, |d| d.sqrt())
                })
                .collect(),
        };
        graph.offsets.push(0);
        for i in 0..n {
            let row = &mut edges[counts[i] as usize..counts[i + 1] as usize];
            row.sort_unstable_by_key(|e| e.0);
            for (at, &(j, d)) in row.iter().enumerate() {
                if at == 0 || row[at - 1].0 != j {
                    graph.neighbours.push(j);
                    graph.distances.push(d);
                }
            }
            graph.offsets.push(graph.neighbours.len() as u32);
        }
        graph
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.spacing.len()
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.spacing.is_empty()
    }

    /// The numbers of the edges of a splat.
    pub fn edges(&self, splat: usize) -> std::ops::Range<usize> {
        self.offsets[splat] as usize..self.offsets[splat + 1] as usize
    }

    /// The splat at the other end of an edge.
    pub fn neighbour(&self, edge: usize) -> usize {
        self.neighbours[edge] as usize
    }

    /// Length of an edge, in scene units.
    pub fn distance(&self, edge: usize) -> f32 {
        self.distances[edge]
    }

    /// Affinity of the two ends of each edge, in (0, 1]: high where they are near for their surroundings, alike in colour and
    /// in features. Both rows of an edge hold the same number.
    pub fn affinities(&self, splats: &Splats, field: Option<&SplatFeatures>) -> Vec<f32> {
        let stride = splats.sh_stride();
        let colour = |i: usize| {
            Vec3::new(splats.sh[i * stride], splats.sh[i * stride + 1], splats.sh[i * stride + 2]) * SH0
        };
        let affinity = |i: usize, edge: usize| {
            let j = self.neighbour(edge);
            let spread = self.spacing[i] * self.spacing[j];
            let d = self.distances[edge];
            let near = if spread > 0.0 { d * d / spread } else { 0.0 };
            let hue = (colour(i) - colour(j)).length_squared() / (COLOUR_SIGMA * COLOUR_SIGMA);
            let hue = if hue.is_finite() { hue } else { 0.0 };
            let feature = field.map_or(0.0, |f| FEATURE_STEEPNESS * (1.0 - f.cosine(i, j)));
            // Never 0: a row of zeros would have no neighbours at all.
            (-0.5 * near - 0.5 * hue - feature).exp().max(1e-6)
        };
        (0..self.len())
            .into_par_iter()
            .with_min_len(1024)
            .flat_map_iter(|i| self.edges(i).map(move |e| affinity(i, e)))
            .collect()
    }

    /// Connected parts of the selected splats: the part's number per splat, `None` for those not selected, and
    /// the number of parts. Parts are numbered by their first splat. Edges that are long for the surroundings
    /// of either end connect only where the two ellipsoids meet.
    pub fn components(&self, splats: &Splats, selected: &[bool]) -> (Vec<Option<u32>>, usize) {
        let mut part = vec![None; self.len()];
        let mut parts = 0;
        let mut stack = Vec::new();
        for start in 0..self.len() {
            if !selected[start] || part[start].is_some() {
                continue;
            }
            part[start] = Some(parts);
            stack.push(start);
            while let Some(i) = stack.pop() {
                for edge in self.edges(i) {
                    let j = self.neighbour(edge);
                    if selected[j] && part[j].is_none() && self.linked(splats, i, edge) {
                        part[j] = Some(parts);
                        stack.push(j);
                    }
                }
            }
            parts += 1;
        }
        (part, parts as usize)
    }

    fn linked(&self, splats: &Splats, i: usize, edge: usize) -> bool {
        let (j, d) = (self.neighbour(edge), self.distances[edge]);
        if d <= LINK_SPACINGS * self.spacing[i].min(self.spacing[j]) {
            return true;
        }
        let along = (splats.mean(j) - splats.mean(i)) / d;
        let extent = |s: usize| ((splats.rotation(s).transpose() * along) * splats.scale(s)).length();
        d <= MEETING_DEVIATIONS * (extent(i) + extent(j))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kept_graph_fits_the_setting_that_it_was_made_with() {
        let means = (0..40).map(|i| [(i % 7) as f32, (i % 5) as f32 * 1.1, i as f32 * 0.3]).collect();
        let splats = Splats { means, ..Splats::default() };
        let fewer = Splats { means: splats.means[1..].to_vec(), ..Splats::default() };
        let kept = SceneGraph::new(&splats, 4);
        assert!(kept.fits(&splats, 4));
        assert!(!kept.fits(&splats, 8) && !kept.fits(&fewer, 4));
        assert!(!SceneGraph::default().fits(&Splats::default(), 4), "none is made yet");
    }
}
