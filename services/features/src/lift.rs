//! Closed-form lifting of targets onto splats (method, section 4): one pass, no optimiser.

use crate::FeatureError;
use crate::error::check_planes;
use rayon::prelude::*;
use segwild_raster::Projected;
use segwild_scene::Image;

/// Splats per task. Fixed, so that results do not depend on the number of threads.
const CHUNK: usize = 4096;

/// Gathers `f_i = sum(w alpha T t) / sum(w alpha T)` over photos that arrive one at a time: the minimiser of
/// the weighted squared distance between each splat's feature and the targets t of the pixels it is seen in.
///
/// Sums run in the order in which photos are added, so add them in a fixed order.
#[derive(Clone, Debug)]
pub struct Lifter {
    channels: usize,
    sums: Vec<f32>,
    weights: Vec<f32>,
}

impl Lifter {
    /// Room for `splats` features of `channels` numbers.
    pub fn new(splats: usize, channels: usize) -> Lifter {
        Lifter { channels, sums: vec![0.0; splats * channels], weights: vec![0.0; splats] }
    }

    /// Adds a photo: `target` has `channels` planes at the size `projected` was made for, `validity` one plane
    /// of weights w >= 0 of that size. `name` is the photo's in errors.
    pub fn add(
        &mut self,
        name: &str,
        projected: &dyn Projected,
        target: &Image,
        validity: &Image,
    ) -> Result<(), FeatureError> {
        let (w, h, c) = (target.width, target.height, target.channels);
        check_planes(name, "feature target", (w, h, c), &target.data)?;
        check_planes(name, "validity map", (w, h, 1), &validity.data)?;
        if c != self.channels {
            let want = self.channels;
            return Err(FeatureError::Shape(format!("{name}: a target of {c} channels, wanted {want}")));
        }
        // One plane more for the weights themselves, so that one gather does.
        let mut weighted = Image::zeros(w, h, c + 1);
        let ones = vec![1.0; w * h];
        let planes = target.data.chunks_exact(w * h).chain([&ones[..]]);
        for (out, plane) in weighted.data.chunks_exact_mut(w * h).zip(planes) {
            for ((out, v), weight) in out.iter_mut().zip(plane).zip(&validity.data) {
                *out = v * weight.max(0.0);
            }
        }
        let gathered = projected.gather(&weighted)?;
        if gathered.len() != self.weights.len() * (c + 1) {
            return Err(FeatureError::Shape(format!(
                "{name}: a projection of {} splats, wanted {}",
                gathered.len() / (c + 1),
                self.weights.len()
            )));
        }
        self.sums
            .par_chunks_mut(CHUNK * c)
            .zip(self.weights.par_chunks_mut(CHUNK))
            .zip(gathered.par_chunks(CHUNK * (c + 1)))
            .for_each(|((sums, weights), gathered)| {
                let rows = gathered.chunks_exact(c + 1);
                for ((sum, weight), row) in sums.chunks_exact_mut(c).zip(weights).zip(rows) {
                    // A splat that a kernel could not handle must not poison the others' sums.
                    if row[c] > 0.0 && row.iter().all(|v| v.is_finite()) {
                        sum.iter_mut().zip(row).for_each(|(s, g)| *s += g);
                        *weight += row[c];
                    }
                }
            });
        Ok(())
    }

    /// How much each splat was seen: `sum(w alpha T)` in pixels.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// The features, `[splat][channel]`, flat; zero for splats that no photo sees.
    pub fn finish(mut self) -> Vec<f32> {
        for (sum, &weight) in self.sums.chunks_exact_mut(self.channels).zip(&self.weights) {
            if weight > 0.0 {
                sum.iter_mut().for_each(|s| *s /= weight);
            }
        }
        self.sums
    }
}
