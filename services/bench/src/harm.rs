//! What is done to a synthetic scene before it is written, so that files and photos disagree.

use glam::{DMat3, DVec3};
use segwild_synthetic::random::Rng;
use segwild_synthetic::{SyntheticPhoto, SyntheticScene};
use serde::{Deserialize, Serialize};

/// What is wrong with a set that is written: the photos are as they were.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Harm {
    /// Every camera is turned about a random axis, by so many degrees (standard deviation).
    pub turn: f64,
    /// Every camera is moved by such a share of the cameras' mean distance from their centre (standard deviation).
    pub shift: f64,
    /// The whole scene lies so many times its cameras' mean distance away from the file's origin.
    pub offset: f64,
    /// So many photos, the first ones, are written over the others in turn, with the others' poses; 0 for none.
    pub copies: usize,
}

impl Harm {
    /// Does it.
    pub fn apply(&self, scene: &mut SyntheticScene, seed: u64) {
        let centres: Vec<DVec3> = scene.photos.iter().map(centre).collect();
        let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        let size = centres.iter().map(|c| (*c - mean).length()).sum::<f64>() / centres.len().max(1) as f64;
        let shift = DVec3::new(1.0, -0.7, 0.4).normalize() * (self.offset * size);
        for (i, photo) in scene.photos.iter_mut().enumerate() {
            let mut rng = Rng::new(seed, (29 << 32) + i as u64);
            let mut gauss = || f64::from(rng.normal());
            let axis = DVec3::new(gauss(), gauss(), gauss()).normalize_or(DVec3::X);
            let angle = gauss() * self.turn.to_radians();
            let moved = DVec3::new(gauss(), gauss(), gauss()) * (self.shift * size / 3f64.sqrt());
            let rotation = DMat3::from_axis_angle(axis, angle) * photo.pose.rotation.as_dmat3();
            let translation = -(rotation * (centres[i] + moved + shift));
            if self.turn > 0.0 || self.shift > 0.0 {
                photo.pose.rotation = rotation.as_mat3();
            }
            if *self != Harm::default() {
                photo.translation = translation;
                photo.pose.translation = translation.as_vec3();
            }
        }
        scene.points.iter_mut().for_each(|p| p.position += shift);
        if self.copies > 0 {
            let first: Vec<_> = scene.photos.iter().take(self.copies).cloned().collect();
            for (i, photo) in scene.photos.iter_mut().enumerate().skip(self.copies) {
                let other = &first[i % first.len()];
                if (other.camera.width, other.camera.height) == (photo.camera.width, photo.camera.height) {
                    photo.photo = other.photo.clone();
                }
            }
        }
    }
}

fn centre(photo: &SyntheticPhoto) -> DVec3 {
    -(photo.pose.rotation.as_dmat3().transpose() * photo.translation)
}
