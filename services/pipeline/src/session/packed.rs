//! The splats for programs that rasterise them themselves, as packed numbers: the scene, and what objects change of it.

use super::resident::Session;
use super::viewing::ShownParts;
use crate::RunError;
use crate::artifacts::selected::Shortened;
use crate::output::light::BlendedAppearance;
use segwild_flow::Stopper;
use segwild_scene::Splats;
use segwild_segmenter::scene_tree::{NONE, SceneTree};
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Splats of a chunk: whole rows of the page's textures, and less than a mebibyte with harmonics of degree 3.
const CHUNK: usize = 4096;

/// The splats for a program that rasterises them itself, little-endian, in parts. Those that contribute most come first, so that
/// some of the first parts show most of the scene.
///
/// The first part is the head, as `u32`: number of splats, degree of the harmonics, whether opacities are compensated for the pixel
/// filter, and splats of a chunk. Each further part is a chunk, the last one with what is left: the splats' indices in the scene
/// (`u32`), then as `f32` all centres (3), opacities in [0, 1] (1), upper triangles of the covariances (6), and colour
/// coefficients (3 per basis function).
///
/// A client may take the parts as slowly as it likes: shapes stay the session's own, and so do colours that no appearance changes.
pub struct PackedSplats {
    splats: Arc<Splats>,
    /// Colour coefficients in the appearance, as in [`Splats::sh`]; `None` where they are the splats' own.
    colours: Option<Vec<f32>>,
    antialias: bool,
    /// Indices of the splats, by contribution.
    order: Vec<u32>,
    /// Splats that are packed already; `None` before the head.
    packed: Option<usize>,
}

impl PackedSplats {
    fn new(
        splats: Arc<Splats>,
        colours: Option<Vec<f32>>,
        antialias: bool,
        tree: Option<&SceneTree>,
    ) -> PackedSplats {
        let order = by_contribution(&splats, tree);
        PackedSplats { splats, colours, antialias, order, packed: None }
    }
}

impl Iterator for PackedSplats {
    type Item = Vec<u8>;

    fn next(&mut self) -> Option<Vec<u8>> {
        let PackedSplats { splats, colours, antialias, order, packed } = self;
        let splats: &Splats = splats;
        let colours = colours.as_ref().unwrap_or(&splats.sh);
        let Some(first) = *packed else {
            let mut head = Vec::new();
            let antialias = u32::from(*antialias);
            add_counts(&mut head, [splats.len() as u32, splats.sh_degree, antialias, CHUNK as u32]);
            *packed = Some(0);
            return Some(head);
        };
        let chunk = &order[first..order.len().min(first + CHUNK)];
        if chunk.is_empty() {
            return None;
        }
        *packed = Some(first + chunk.len());
        let (stride, all) = (splats.sh_stride(), || chunk.iter().map(|i| *i as usize));
        let mut bytes = Vec::with_capacity(4 * chunk.len() * (11 + stride));
        add_counts(&mut bytes, chunk.iter().copied());
        all().for_each(|i| add_numbers(&mut bytes, &splats.means[i]));
        all().for_each(|i| add_numbers(&mut bytes, &[splats.opacity(i)]));
        all().for_each(|i| add_numbers(&mut bytes, &upper_triangle(splats, i)));
        all().for_each(|i| add_numbers(&mut bytes, &colours[stride * i..][..stride]));
        Some(bytes)
    }
}

/// The splats in the order of what they contribute, the largest first: the light that all views see of them, which the scene tree
/// has: of a splat that others follow in it, and of these, what all of them have together. Those without, and all where there is no
/// tree, come by opacity times area, the product of the two longest axes.
fn by_contribution(splats: &Splats, tree: Option<&SceneTree>) -> Vec<u32> {
    let light = |i: usize| -> Option<f32> {
        let tree = tree?;
        let leaf = *tree.leaf.get(i).filter(|leaf| **leaf != NONE)?;
        Some(tree.trees.first()?.groups.get(leaf as usize)?.area)
    };
    let area = |i: usize| {
        let scales = splats.log_scales[i];
        let shortest = scales.into_iter().fold(f32::INFINITY, f32::min);
        splats.opacity(i) * (scales.iter().sum::<f32>() - shortest).exp()
    };
    let contribution: Vec<[f32; 2]> = (0..splats.len()).map(|i| [light(i).unwrap_or(0.0), area(i)]).collect();
    let larger = |a: &u32, b: &u32| -> Ordering {
        let (a, b) = (contribution[*a as usize], contribution[*b as usize]);
        b[0].total_cmp(&a[0]).then(b[1].total_cmp(&a[1]))
    };
    let mut order: Vec<u32> = (0..splats.len() as u32).collect();
    order.sort_by(larger);
    order
}

impl Session {
    /// The splats for a program that rasterises them itself.
    ///
    /// # Errors
    /// When the photo `appearance` is unknown or took no part in the training.
    pub fn packed_splats(&self, appearance: &BlendedAppearance) -> Result<PackedSplats, RunError> {
        let tree = self.tree().map(|tree| &**tree);
        let light = appearance.light(&self.scene, &self.model)?;
        let colours = self.model.changes_colours().then(|| self.model.baked(&light.into()).sh);
        Ok(PackedSplats::new(self.splats.clone(), colours, self.model.antialias, tree))
    }

    /// What `parts.cut` and `parts.appearances` change of [`Session::packed_splats`], little-endian: numbers of splats with
    /// another shape and of splats with other colours, and the degree of the harmonics, as `u32`. For the shapes follow the splats'
    /// indices (`u32`), then as `f32` all centres (3) and upper triangles of the covariances (6); for the colours the indices, then
    /// all coefficients (3 per basis function). A splat is in each list once at most, in order.
    ///
    /// # Errors
    /// When a photo whose appearance is requested is unknown or took no part in the training, or `stopper` stops it.
    pub fn packed_changes(&self, parts: &ShownParts, stopper: &Stopper) -> Result<Vec<u8>, RunError> {
        let splats = &self.model.splats;
        // As where the scene is rendered: of several changes of a splat, the last counts.
        let shapes: BTreeMap<u32, &Shortened> =
            parts.cut.iter().flat_map(|cut| &cut.changed).map(|shape| (shape.splat, shape)).collect();
        let mut lit: Vec<Option<usize>> = vec![None; splats.len()];
        for (k, (labels, _)) in parts.appearances.iter().enumerate() {
            lit.iter_mut().zip(*labels).filter(|(_, label)| **label).for_each(|(lit, _)| *lit = Some(k));
        }
        let mut colours: BTreeMap<u32, Vec<f32>> = BTreeMap::new();
        for (k, (_, appearance)) in parts.appearances.iter().enumerate() {
            RunError::unless_running(stopper)?;
            let own: Vec<usize> = (0..splats.len()).filter(|&i| lit[i] == Some(k)).collect();
            if own.is_empty() {
                continue;
            }
            let mut model = self.model.clone();
            model.select(&own);
            // An appearance may depend on where a splat is.
            for (mean, i) in Arc::make_mut(&mut model.splats).means.iter_mut().zip(&own) {
                *mean = shapes.get(&(*i as u32)).map_or(*mean, |shape| shape.mean);
            }
            let baked = model.baked(&appearance.light(&self.scene, &model)?.into());
            let rows = baked.sh.chunks_exact(baked.sh_stride());
            colours.extend(own.iter().zip(rows).map(|(i, row)| (*i as u32, row.to_vec())));
        }
        let mut bytes = Vec::new();
        add_counts(&mut bytes, [shapes.len() as u32, colours.len() as u32, splats.sh_degree]);
        add_counts(&mut bytes, shapes.keys().copied());
        shapes.values().for_each(|shape| add_numbers(&mut bytes, &shape.mean));
        let mut shape = splats.select(&shapes.keys().map(|i| *i as usize).collect::<Vec<_>>());
        shape.log_scales = shapes.values().map(|shape| shape.log_scales).collect();
        shape.rotations = shapes.values().map(|shape| shape.rotation).collect();
        (0..shape.len()).for_each(|i| add_numbers(&mut bytes, &upper_triangle(&shape, i)));
        add_counts(&mut bytes, colours.keys().copied());
        colours.values().for_each(|row| add_numbers(&mut bytes, row));
        Ok(bytes)
    }
}

fn add_counts(bytes: &mut Vec<u8>, counts: impl IntoIterator<Item = u32>) {
    bytes.extend(counts.into_iter().flat_map(u32::to_le_bytes));
}

fn add_numbers(bytes: &mut Vec<u8>, numbers: &[f32]) {
    bytes.extend(numbers.iter().flat_map(|v| v.to_le_bytes()));
}

/// The upper triangle of a splat's covariance.
fn upper_triangle(splats: &Splats, i: usize) -> [f32; 6] {
    let [[xx, xy, xz], [_, yy, yz], [_, _, zz]] = splats.covariance(i).to_cols_array_2d();
    [xx, xy, xz, yy, yz, zz]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Splats of which the largest is the last.
    fn growing(n: usize) -> Splats {
        Splats {
            means: (0..n).map(|i| [i as f32, 0.0, 0.0]).collect(),
            log_scales: (0..n).map(|i| [(i as f32 + 1.0).ln(), 0.0, -1.0]).collect(),
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacities: vec![0.0; n],
            sh_degree: 1,
            sh: (0..12 * n).map(|k| k as f32).collect(),
        }
    }

    fn number(bytes: &[u8], at: usize) -> u32 {
        u32::from_le_bytes(bytes[4 * at..][..4].try_into().unwrap())
    }

    #[test]
    fn parts_come_by_contribution_and_fit_into_a_message() {
        let n = CHUNK + 5;
        let splats = Arc::new(growing(n));
        let mut packed = PackedSplats::new(splats.clone(), None, true, None);
        let head = packed.next().unwrap();
        assert_eq!([0, 1, 2, 3].map(|k| number(&head, k)), [n as u32, 1, 1, CHUNK as u32]);
        let chunks: Vec<Vec<u8>> = packed.collect();
        assert_eq!(chunks.iter().map(Vec::len).collect::<Vec<_>>(), [CHUNK, 5].map(|k| 4 * k * (11 + 12)));
        let indices = (0..n).map(|k| number(&chunks[k / CHUNK], k % CHUNK));
        assert!(indices.eq((0..n as u32).rev()));
        // The centre and the colour of the second splat of the last chunk.
        let last = |at: usize| f32::from_bits(number(&chunks[1], at));
        assert_eq!((last(5 + 3), last(5 * 11 + 12)), (3.0, 36.0));
        // The same in an appearance: nothing else differs.
        let colours = splats.sh.iter().map(|v| -v).collect();
        let lit: Vec<Vec<u8>> = PackedSplats::new(splats, Some(colours), true, None).skip(1).collect();
        let before_colours = 4 * 5 * 11;
        assert_eq!(lit[1][..before_colours], chunks[1][..before_colours]);
        assert_eq!(f32::from_bits(number(&lit[1], 5 * 11 + 12)), -36.0);
        const { assert!(4 * CHUNK * (11 + 3 * 16) < 1 << 20) };
    }
}
