//! Lifting: sums per splat over views (method, section 4).

use rayon::prelude::*;
use segwild_raster::{Projected, RasterError};
use segwild_scene::Image;

/// Splats per task. Fixed, so that results do not depend on the number of threads.
const CHUNK: usize = 4096;

/// Sums over views of [`Projected::gather`]: a row of numbers per splat, and its weight. [`Lifting::add`] adds a view,
/// on the host or on the device.
pub struct Lifting {
    row: usize,
    sums: Vec<f32>,
    weights: Vec<f32>,
    pub(crate) on_device: Option<Box<dyn DeviceLifting>>,
}

/// Sums on a device.
pub trait DeviceLifting: Send + Sync {
    /// Adds [`Projected::gather`] of an image to the sums; its last plane is the weight that its pixels have.
    ///
    /// # Panics
    /// If the view is of another device, or of another number of splats.
    fn add(&self, view: &dyn Projected, image: &Image) -> Result<(), RasterError>;

    /// The sums, `[splat][number]`, and the weights.
    fn download(&self) -> Result<(Vec<f32>, Vec<f32>), RasterError>;
}

impl Lifting {
    /// Rows of `row` numbers for so many splats, all 0.
    pub fn new(splats: usize, row: usize) -> Lifting {
        Lifting { row, sums: vec![0.0; splats * row], weights: vec![0.0; splats], on_device: None }
    }

    /// Number of splats.
    pub(crate) fn splats(&self) -> usize {
        self.weights.len()
    }

    /// Numbers of a row.
    pub fn row(&self) -> usize {
        self.row
    }

    /// Adds [`Projected::gather`] of an image; its last plane is the weight that its pixels have. A splat with a number
    /// that is not finite, or without weight, keeps its sums: a splat that a kernel could not handle in one view must
    /// not poison the other views.
    ///
    /// # Panics
    /// If the sums are on the device of another engine than the view, or of another number of splats.
    pub fn add(&mut self, view: &dyn Projected, image: &Image) -> Result<(), RasterError> {
        match &self.on_device {
            Some(on_device) => on_device.add(view, image)?,
            None => self.add_rows(&view.gather(image)?),
        }
        Ok(())
    }

    /// Adds the sums of a view, `[splat][row + 1]`, the weight last.
    fn add_rows(&mut self, output: &[f32]) {
        let c = self.row;
        assert_eq!(output.len(), self.weights.len() * (c + 1), "splats");
        self.sums
            .par_chunks_mut(CHUNK * c.max(1))
            .zip(self.weights.par_chunks_mut(CHUNK))
            .zip(output.par_chunks(CHUNK * (c + 1)))
            .for_each(|((sums, weights), output)| {
                let rows = output.chunks_exact(c + 1);
                for ((sum, weight), row) in sums.chunks_exact_mut(c.max(1)).zip(weights).zip(rows) {
                    if row[c] > 0.0 && row.iter().all(|v| v.is_finite()) {
                        sum.iter_mut().zip(row).for_each(|(s, g)| *s += g);
                        *weight += row[c];
                    }
                }
            });
    }

    /// The sums, `[splat][number]`, and the weights, wherever they are.
    pub fn finish(self) -> Result<(Vec<f32>, Vec<f32>), RasterError> {
        match &self.on_device {
            Some(on_device) => on_device.download(),
            None => Ok((self.sums, self.weights)),
        }
    }
}
