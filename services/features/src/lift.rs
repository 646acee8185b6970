//! Closed-form lifting of targets onto splats (method, section 4): one pass, no optimiser.

use crate::FeatureError;
use crate::error::check_planes;
use segwild_objective::FieldBackend;
use segwild_objective::field::Lifting;
use segwild_raster::Projected;
use segwild_scene::Image;

/// Gathers `f_i = sum(w alpha T t) / sum(w alpha T)` over photos that arrive one at a time: the minimiser of
/// the weighted squared distance between each splat's feature and the targets t of the pixels it is seen in.
///
/// Sums run in the order in which photos are added, so add them in a fixed order.
pub struct Lifter {
    splats: usize,
    sums: Lifting,
}

/// The features lifted from the photos.
#[derive(Clone, Debug, PartialEq)]
pub struct Lifted {
    /// The features, `[splat][channel]`, flat; zero for splats that no photo sees.
    pub values: Vec<f32>,
    /// How much each splat was seen: `sum(w alpha T)` in pixels.
    pub weights: Vec<f32>,
}

impl Lifter {
    /// For `splats` features of `channels` numbers.
    pub fn new(splats: usize, channels: usize) -> Lifter {
        Lifter { splats, sums: Lifting::new(splats, channels) }
    }

    /// Allocates the sums on the device of the engine whose projections are added, if it has the memory.
    pub fn allocate_on_device(&mut self, engine: &dyn FieldBackend) -> Result<(), FeatureError> {
        Ok(self.sums.allocate_on_device(engine)?)
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
        if c != self.sums.row() {
            let want = self.sums.row();
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
        let seen = projected.radii().len();
        if seen != self.splats {
            let want = self.splats;
            return Err(FeatureError::Shape(format!("{name}: a projection of {seen} splats, wanted {want}")));
        }
        Ok(self.sums.add(projected, &weighted)?)
    }

    /// The features.
    pub fn finish(self) -> Result<Lifted, FeatureError> {
        let channels = self.sums.row();
        let (mut values, weights) = self.sums.finish()?;
        for (sum, &weight) in values.chunks_exact_mut(channels.max(1)).zip(&weights) {
            if weight > 0.0 {
                sum.iter_mut().for_each(|s| *s /= weight);
            }
        }
        Ok(Lifted { values, weights })
    }
}
