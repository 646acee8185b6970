//! The networks of the appearance model `gsw` while a device trains them.

use super::appearance::WHOLE;
use super::{GswAppearance, GswWidth, ImageConditioning, LAYER};
use crate::adam::{Adam, Rule};
use segwild_nn::Map;

/// Input of the UNet for a photo, to be run on a device.
#[derive(Debug)]
pub struct UNetInput<'a> {
    /// Of [`super::PLANES`] planes.
    pub image: Map,
    /// Of [`super::BESIDE`] planes, at half the size.
    pub beside: Map,
    /// Whether it is the whole photo.
    pub whole: bool,
    /// The photo.
    pub image_conditioning: &'a ImageConditioning,
}

/// The networks with their optimiser state, to be trained on a device: the weights of [`super::Networks`], then the
/// colour head's last layer.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingNetworks {
    /// How wide they are.
    pub width: GswWidth,
    /// The weights.
    pub weights: Vec<f32>,
    /// Their first moments.
    pub first: Vec<f32>,
    /// And second ones.
    pub second: Vec<f32>,
}

impl GswAppearance {
    /// The networks and their optimiser state, to be trained on a device.
    pub fn training_networks(&self) -> TrainingNetworks {
        let moments = [&self.net_moments, &self.point_moments, &self.layer_moments].map(Adam::moments);
        let [first, second] = [0, 1].map(|which| moments.map(|of| of[which]).concat());
        TrainingNetworks {
            width: self.width(),
            weights: [self.weights.as_slice(), &self.layer].concat(),
            first,
            second,
        }
    }

    /// Takes back the state that [`GswAppearance::training_networks`] returned.
    ///
    /// # Panics
    /// If it is of other networks.
    pub fn restore_networks(&mut self, trained: TrainingNetworks) {
        let TrainingNetworks { mut weights, first, second, .. } = trained;
        let (border, all) = (self.nets().border, self.weights.len());
        self.layer.copy_from_slice(&weights.split_off(all));
        self.weights.copy_from_slice(&weights);
        let ends = [0..border, border..all, all..all + LAYER];
        let groups = [&mut self.net_moments, &mut self.point_moments, &mut self.layer_moments];
        for (moments, at) in groups.into_iter().zip(ends) {
            moments.set_moments(first[at.clone()].to_vec(), second[at].to_vec());
        }
    }

    /// Counts a step of the networks that a device computes, and returns its rules: of UNet and head, and of the
    /// others. `scale` as for [`crate::Appearance::step`].
    pub fn advance(&mut self, scale: f32) -> [Rule; 2] {
        let net = self.net_moments.advance(self.net_rate * scale);
        let point = self.point_moments.advance(self.point_rate * scale);
        let layer = self.layer_moments.advance(self.point_rate * scale);
        debug_assert_eq!(point, layer, "they step together");
        [net, point]
    }

    /// Input of the UNet for a view's photo in a step with the random number `draw`, for a device; `None` as for
    /// [`GswAppearance::appearance_maps`].
    pub fn unet_input(&self, view: usize, draw: u64) -> Option<UNetInput<'_>> {
        let (image_conditioning, seen) = self.unet_input_of(view, Some(draw))?;
        let whole = seen == WHOLE;
        let (image, beside) = image_conditioning.planes(seen);
        Some(UNetInput { image, beside, whole, image_conditioning })
    }
}
