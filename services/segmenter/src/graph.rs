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

/// Rows of the graph that one task takes.
const MIN_ROWS: usize = 1024;

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

    fn are_known(&self, with_features: bool) -> bool {
        self.computed[usize::from(with_features)].get().is_some()
    }

    /// Bytes that they take in memory.
    pub fn bytes(&self) -> usize {
        self.computed.iter().filter_map(OnceLock::get).map(|known| size_of_val(known.as_slice())).sum()
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

    /// Bytes that it takes in memory with its affinities.
    pub fn bytes(&self) -> usize {
        self.graph.as_ref().map_or(0, NeighbourGraph::bytes) + self.affinities.bytes()
    }

    /// Computes the affinities before a selection needs them. False where there was nothing to compute.
    pub(crate) fn compare(&self, splats: &Splats, field: Option<&SplatFeatures>) -> bool {
        let Some(graph) = self.graph.as_ref().filter(|_| !self.affinities.are_known(field.is_some())) else {
            return false;
        };
        self.affinities.of(graph, splats, field);
        true
    }
}

impl NeighbourGraph {
    /// Links every splat with its `k` nearest, in either direction. Splats whose centre is not finite stay alone.
    pub fn new(splats: &Splats, k: usize) -> NeighbourGraph {
        NeighbourGraph::of_points(&splats.means, k)
    }

    /// The same over bare points. It takes little more memory than the graph that it makes.
    pub fn of_points(points: &[[f32; 3]], k: usize) -> NeighbourGraph {
        let knn::Neighbours { index, distance2, .. } = knn::nearest(points, k);
        let furthest = |i: usize| {
            let row = &distance2[i * k..(i + 1) * k];
            row.iter().rev().find(|d| d.is_finite()).map_or(0.0, |d| d.sqrt())
        };
        let spacing = (0..points.len()).map(furthest).collect();
        // What has served is freed before the next array is made.
        drop(distance2);
        let (offsets, neighbours) = symmetric_rows(&index, k, points.len());
        drop(index);
        let mut distances = vec![0.0; neighbours.len()];
        for_each_row(&offsets, 0, &mut distances, &|i: usize, row: &mut [f32]| {
            for (distance, &j) in row.iter_mut().zip(&neighbours[offsets[i] as usize..]) {
                *distance = knn::distance2(points[i], points[j as usize]).sqrt();
            }
        });
        NeighbourGraph { nearest: k, offsets, neighbours, distances, spacing }
    }

    /// Bytes that it takes in memory.
    pub fn bytes(&self) -> usize {
        let NeighbourGraph { nearest: _, offsets, neighbours, distances, spacing } = self;
        size_of_val(offsets.as_slice())
            + size_of_val(neighbours.as_slice())
            + size_of_val(distances.as_slice())
            + size_of_val(spacing.as_slice())
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
        let mut affinities = vec![0.0; self.neighbours.len()];
        for_each_row(&self.offsets, 0, &mut affinities, &|i: usize, row: &mut [f32]| {
            row.iter_mut().zip(self.edges(i)).for_each(|(of_edge, edge)| *of_edge = affinity(i, edge));
        });
        affinities
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

/// The rows that link every point with its nearest and with those that it is among the nearest of: their offsets, and
/// the neighbours. `index` has the `k` nearest of each of `n` points, [`NONE`] where there are fewer.
fn symmetric_rows(index: &[u32], k: usize, n: usize) -> (Vec<u32>, Vec<u32>) {
    let nearest = |i: usize| &index[i * k..(i + 1) * k];
    // Of two points that are among each other's nearest, each is in the other's row without being added there.
    let mut mutual = vec![false; index.len()];
    mutual.par_chunks_mut(k.max(1)).enumerate().with_min_len(MIN_ROWS).for_each(|(i, row)| {
        for (mutual, &j) in row.iter_mut().zip(nearest(i)) {
            *mutual = j != NONE && nearest(j as usize).contains(&(i as u32));
        }
    });
    let linked = |i: usize| {
        let row = nearest(i).iter().zip(&mutual[i * k..(i + 1) * k]);
        row.filter(|(j, _)| **j != NONE).map(|(&j, &mutual)| (j as usize, mutual))
    };
    let mut offsets = vec![0u32; n + 1];
    for i in 0..n {
        for (j, mutual) in linked(i) {
            offsets[i + 1] += 1;
            offsets[j + 1] += u32::from(!mutual);
        }
    }
    for i in 0..n {
        offsets[i + 1] += offsets[i];
    }
    let mut next = offsets.clone();
    let mut neighbours = vec![0u32; offsets[n] as usize];
    let mut link = |from: usize, to: usize| {
        neighbours[next[from] as usize] = to as u32;
        next[from] += 1;
    };
    for i in 0..n {
        for (j, mutual) in linked(i) {
            link(i, j);
            if !mutual {
                link(j, i);
            }
        }
    }
    for_each_row(&offsets, 0, &mut neighbours, &|_: usize, row: &mut [u32]| row.sort_unstable());
    (offsets, neighbours)
}

/// Calls a function with each row of `values` and its number, on all cores. Row `first + i` lies at
/// `offsets[i]..offsets[i + 1]`, counted from `offsets[0]`.
fn for_each_row<T: Send>(
    offsets: &[u32],
    first: usize,
    values: &mut [T],
    apply: &(impl Fn(usize, &mut [T]) + Sync),
) {
    let rows = offsets.len() - 1;
    let start = |row: usize| (offsets[row] - offsets[0]) as usize;
    if rows <= MIN_ROWS {
        (0..rows).for_each(|row| apply(first + row, &mut values[start(row)..start(row + 1)]));
        return;
    }
    let middle = rows / 2;
    let (low, high) = values.split_at_mut(start(middle));
    rayon::join(
        || for_each_row(&offsets[..=middle], first, low, apply),
        || for_each_row(&offsets[middle..], first + middle, high, apply),
    );
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
