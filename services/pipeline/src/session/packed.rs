//! The splats for programs that rasterise them themselves, as packed numbers: the scene, and what objects change of it.

use super::resident::Session;
use super::viewing::ShownParts;
use crate::RunError;
use crate::artifacts::selected::Shortened;
use crate::output::light::BlendedAppearance;
use segwild_flow::{Phase, Stopper};
use segwild_scene::Splats;
use std::collections::BTreeMap;

impl Session {
    /// The splats for a program that rasterises them itself, little-endian: number of splats, degree of the harmonics, and
    /// whether opacities are compensated for the pixel filter, as `u32`; then as `f32` all centres (3), opacities in [0, 1]
    /// (1), upper triangles of the covariances (6), and colour coefficients (3 per basis function).
    ///
    /// # Errors
    /// When the photo `appearance` is unknown or took no part in the training.
    pub fn packed_splats(&self, appearance: &BlendedAppearance) -> Result<Vec<u8>, RunError> {
        let splats = self.in_colour(appearance)?;
        let n = splats.len();
        let mut bytes = Vec::with_capacity(12 + 4 * (10 * n + splats.sh.len()));
        add_counts(&mut bytes, [n as u32, splats.sh_degree, u32::from(self.model.antialias)]);
        add_numbers(&mut bytes, splats.means.as_flattened());
        add_numbers(&mut bytes, &(0..n).map(|i| splats.opacity(i)).collect::<Vec<f32>>());
        (0..n).for_each(|i| add_numbers(&mut bytes, &upper_triangle(&splats, i)));
        add_numbers(&mut bytes, &splats.sh);
        Ok(bytes)
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
            if stopper.phase() != Phase::Running {
                return Err(RunError::Interrupted);
            }
            let own: Vec<usize> = (0..splats.len()).filter(|&i| lit[i] == Some(k)).collect();
            if own.is_empty() {
                continue;
            }
            let mut model = self.model.clone();
            model.select(&own);
            // An appearance may depend on where a splat is.
            for (mean, i) in model.splats.means.iter_mut().zip(&own) {
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
