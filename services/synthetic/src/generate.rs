//! Builds the scene of a seed, and takes its photos.

use crate::cameras::sample_camera;
use crate::error::SyntheticError;
use crate::layout::build;
use crate::light::{Day, PhotoLight};
use crate::options::{LightVariation, SyntheticOptions};
use crate::photo::SyntheticPhoto;
use crate::points::reconstruct;
use crate::random::Rng;
use crate::scene::SyntheticScene;
use crate::trace::expose;
use crate::transient::Crowd;
use glam::Vec3;
use segwild_scene::Pose;

/// Makes the set. The same options give the same bytes, whatever the number of threads.
pub fn generate(options: &SyntheticOptions) -> Result<SyntheticScene, SyntheticError> {
    options.check()?;
    let world = build(options.seed);
    let count = options.train + options.test;
    let (mut trained, mut tested) = (0, 0);
    let mut photos = Vec::with_capacity(count);
    let mut shots = Vec::with_capacity(count);
    for index in 0..count {
        let test = (index + 1) * options.test / count > index * options.test / count;
        let (stream, rank) = if test { (2 << 20, &mut tested) } else { (1 << 20, &mut trained) };
        let shot = sample_camera(&world, options, stream, *rank)?;
        let mut rng = Rng::new(options.seed, (3 << 20) + stream + *rank as u64);
        *rank += 1;
        let photo_light = photo_light_of(options, &mut rng);
        let share = if test { 0.0 } else { options.occlusion * rng.range(0.88, 1.12) };
        let crowd = Crowd::random(&mut rng, share, shot.camera.width, shot.camera.height);
        let exposed = expose(&world, &shot, &photo_light, &crowd);
        let instances = exposed.parts.iter().map(|&p| world.parts[usize::from(p)].instance).collect();
        let units = options.units as f32;
        photos.push(SyntheticPhoto {
            name: format!("photo_{index:03}.png"),
            camera: shot.camera,
            pose: Pose { translation: shot.pose.translation * units, ..shot.pose },
            translation: shot.pose.translation.as_dvec3() * options.units,
            test,
            front: shot.front,
            photo: exposed.photo,
            clean: exposed.clean,
            depth: exposed.depth.iter().map(|d| d * units).collect(),
            instances,
            parts: exposed.parts,
            transients: exposed.transients,
            photo_light,
        });
        shots.push(shot);
    }
    let points = reconstruct(&world, options, &photos, &shots);
    Ok(SyntheticScene {
        options: options.clone(),
        instances: world.instances.clone(),
        parts: world.parts.clone(),
        photos,
        points,
        world,
    })
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
