//! One photo before it is taken: all that is sampled for it, and no pixels.

use crate::cameras::{CameraShot, sample_camera};
use crate::error::SyntheticError;
use crate::light::{Day, PhotoLight};
use crate::options::{LightVariation, SyntheticOptions};
use crate::photo::{PhotoRecord, SyntheticPhoto};
use crate::random::Rng;
use crate::trace::{colour_at, expose, is_covered};
use crate::transient::Crowd;
use crate::world::SyntheticWorld;
use glam::{Vec2, Vec3};
use segwild_scene::Pose;

/// One photo before it is taken.
#[derive(Clone, Debug)]
pub struct PlannedPhoto {
    /// What the reconstruction has of it, in file units.
    pub record: PhotoRecord,
    /// Its camera, in the world's own units.
    pub shot: CameraShot,
    photo_light: PhotoLight,
    crowd: Crowd,
}

impl PlannedPhoto {
    /// Samples photo `index` of the set: the `rank`-th of the test photos, or of the others. What it samples depends on no other
    /// photo.
    pub fn sample(
        world: &SyntheticWorld,
        options: &SyntheticOptions,
        index: usize,
        test: bool,
        rank: usize,
    ) -> Result<PlannedPhoto, SyntheticError> {
        let stream = if test { 2 << 20 } else { 1 << 20 };
        let shot = sample_camera(world, options, stream, rank)?;
        let mut rng = Rng::new(options.seed, (3 << 20) + stream + rank as u64);
        let photo_light = photo_light_of(options, &mut rng);
        let share = if test { 0.0 } else { options.occlusion * rng.range(0.88, 1.12) };
        let crowd = Crowd::random(&mut rng, share, shot.camera.width, shot.camera.height);
        let record = PhotoRecord {
            name: photo_name(index),
            camera: shot.camera,
            pose: Pose { translation: shot.pose.translation * options.units as f32, ..shot.pose },
            translation: shot.pose.translation.as_dvec3() * options.units,
            test,
        };
        Ok(PlannedPhoto { record, shot, photo_light, crowd })
    }

    /// Takes it. Its rows are traced in parallel.
    pub fn take(&self, world: &SyntheticWorld, options: &SyntheticOptions) -> SyntheticPhoto {
        let exposed = expose(world, &self.shot, &self.photo_light, &self.crowd);
        let instances = exposed.parts.iter().map(|&p| world.parts[usize::from(p)].instance).collect();
        let units = options.units as f32;
        let PhotoRecord { name, camera, pose, translation, test } = self.record.clone();
        SyntheticPhoto {
            name,
            camera,
            pose,
            translation,
            test,
            front: self.shot.front,
            photo: exposed.photo,
            clean: exposed.clean,
            depth: exposed.depth.iter().map(|d| d * units).collect(),
            instances,
            parts: exposed.parts,
            transients: exposed.transients,
            photo_light: self.photo_light.clone(),
        }
    }

    /// Whether a transient touches the pixel under a position of its frame.
    pub fn is_covered(&self, position: Vec2) -> bool {
        is_covered(&self.shot, &self.crowd, [position.x as usize, position.y as usize])
    }

    /// sRGB of the photo at the pixel under a position of its frame, in [0, 1].
    pub fn colour_at(&self, world: &SyntheticWorld, position: Vec2) -> Vec3 {
        let pixel = [position.x as usize, position.y as usize];
        colour_at(world, &self.shot, &self.photo_light, &self.crowd, pixel)
    }
}

/// File name of photo `index` of a set.
pub fn photo_name(index: usize) -> String {
    format!("photo_{index:03}.png")
}

/// Samples a photo's appearance.
fn photo_light_of(options: &SyntheticOptions, rng: &mut Rng) -> PhotoLight {
    let mut photo_light = PhotoLight::canonical();
    let s = options.appearance_strength;
    let (sun, camera, affine) = match options.photo_light {
        LightVariation::None => (false, false, false),
        LightVariation::Affine => (false, false, true),
        LightVariation::Sun => (true, false, false),
        LightVariation::Camera => (false, true, false),
        LightVariation::Mixed => {
            let (sun, camera, affine) = (rng.chance(0.65), rng.chance(0.6), rng.chance(0.3));
            (sun || !(camera || affine), camera, affine)
        }
    };
    if sun {
        photo_light.day = Day::random(rng, s);
        photo_light.own_day = true;
    }
    if camera {
        photo_light.exposure = s * rng.range(-0.65, 0.65);
        photo_light.gamma = 1.0 + s * rng.range(-0.18, 0.25);
        photo_light.vignette = (s * rng.range(0.0, 0.5)).min(0.95);
    }
    if affine {
        // On top of another appearance, or as one among many, the full range would not pass for a photo.
        let s = if options.photo_light == LightVariation::Mixed { 0.4 * s } else { s };
        photo_light.scale = Vec3::ONE + rng.triple(-0.2, 0.2) * s;
        photo_light.shift = rng.triple(-0.2, 0.2) * s;
    }
    photo_light
}
