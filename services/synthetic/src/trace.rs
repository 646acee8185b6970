//! Takes the photos.

use crate::cameras::CameraShot;
use crate::light::{Day, PhotoLight, sun_samples};
use crate::transient::{Crowd, radiance};
use crate::world::SyntheticWorld;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use segwild_scene::{Image, Mask};

/// Samples of a pixel, as offsets from its corner.
const SAMPLES: [Vec2; 4] =
    [Vec2::new(0.25, 0.25), Vec2::new(0.75, 0.25), Vec2::new(0.25, 0.75), Vec2::new(0.75, 0.75)];

/// What one shot gives.
pub struct Exposed {
    /// The photo: with its appearance and transients.
    pub photo: Image,
    /// The same view under the canonical light, with nobody in it.
    pub clean: Image,
    /// Distance along the optical axis at each pixel's centre, in the world's units; 0 where the sky is.
    pub depth: Vec<f32>,
    /// Part at each pixel's centre; 0 is the sky.
    pub parts: Vec<u16>,
    /// Pixels that transients touch.
    pub transients: Mask,
}

struct Pixel {
    photo: Vec3,
    clean: Vec3,
    depth: f32,
    part: u16,
    covered: bool,
}

/// Rows that are traced at once: until they are stored, they take as much memory again as what is stored of them.
const BAND: usize = 256;

/// Renders a shot.
pub fn expose(world: &SyntheticWorld, shot: &CameraShot, photo_light: &PhotoLight, crowd: &Crowd) -> Exposed {
    let (w, h) = (shot.camera.width as usize, shot.camera.height as usize);
    let lens = PhotoTracer::new(world, shot, photo_light, crowd);
    let mut out = Exposed {
        photo: Image::zeros(w, h, 3),
        clean: Image::zeros(w, h, 3),
        depth: Vec::with_capacity(w * h),
        parts: Vec::with_capacity(w * h),
        transients: Mask::empty(w as u32, h as u32),
    };
    for top in (0..h).step_by(BAND) {
        let rows = (top..h.min(top + BAND)).into_par_iter();
        let rows: Vec<Vec<Pixel>> = rows.map(|y| (0..w).map(|x| lens.pixel(x, y)).collect()).collect();
        for (i, pixel) in (top * w..).zip(rows.into_iter().flatten()) {
            for c in 0..3 {
                out.photo.data[c * w * h + i] = eight_bits(pixel.photo[c]);
                out.clean.data[c * w * h + i] = eight_bits(pixel.clean[c]);
            }
            out.depth.push(pixel.depth);
            out.parts.push(pixel.part);
            if pixel.covered {
                out.transients.set((i % w) as u32, (i / w) as u32, true);
            }
        }
    }
    out
}

/// What [`expose`] gives as the photo's sRGB at one pixel.
pub fn colour_at(
    world: &SyntheticWorld,
    shot: &CameraShot,
    photo_light: &PhotoLight,
    crowd: &Crowd,
    [x, y]: [usize; 2],
) -> Vec3 {
    let photo = PhotoTracer::new(world, shot, photo_light, crowd).pixel(x, y).photo;
    Vec3::from_array(photo.to_array().map(eight_bits))
}

/// Whether [`expose`] finds that a transient touches a pixel.
pub fn is_covered(shot: &CameraShot, crowd: &Crowd, [x, y]: [usize; 2]) -> bool {
    let (corner, frame) = (Vec2::new(x as f32, y as f32), frame_of(shot));
    SAMPLES.into_iter().any(|offset| crowd.at(corner + offset, frame.x, frame.y).is_some())
}

/// Width and height of a shot in pixels.
fn frame_of(shot: &CameraShot) -> Vec2 {
    Vec2::new(shot.camera.width as f32, shot.camera.height as f32)
}

/// The value as an 8-bit file keeps it, so that a photo in memory and its file are the same.
fn eight_bits(x: f32) -> f32 {
    (x.clamp(0.0, 1.0) * 255.0).round() / 255.0
}

struct PhotoTracer<'a> {
    world: &'a SyntheticWorld,
    shot: &'a CameraShot,
    photo_light: &'a PhotoLight,
    crowd: &'a Crowd,
    canonical: PhotoLight,
    /// Directions to the sun, one per sample of a pixel: those of the canonical light, and the photo's own.
    suns: ([Vec3; 4], [Vec3; 4]),
}

impl<'a> PhotoTracer<'a> {
    fn new(
        world: &'a SyntheticWorld,
        shot: &'a CameraShot,
        photo_light: &'a PhotoLight,
        crowd: &'a Crowd,
    ) -> PhotoTracer<'a> {
        let canonical = PhotoLight::canonical();
        let suns = (sun_samples(canonical.day.sun), sun_samples(photo_light.day.sun));
        PhotoTracer { world, shot, photo_light, crowd, canonical, suns }
    }

    fn ray(&self, pixel: Vec2) -> Vec3 {
        (self.shot.pose.rotation.transpose() * self.shot.camera.ray(pixel)).normalize()
    }

    fn pixel(&self, x: usize, y: usize) -> Pixel {
        let camera = &self.shot.camera;
        let corner = Vec2::new(x as f32, y as f32);
        let middle = corner + Vec2::splat(0.5);
        let towards = self.ray(middle);
        let hit = self.world.closest(self.shot.eye, towards);
        let forward = self.shot.pose.rotation.transpose() * Vec3::Z;
        let (depth, part) = hit.map_or((0.0, 0), |hit| (hit.t * towards.dot(forward), self.world.part(&hit)));

        let frame = frame_of(self.shot);
        let edge = (middle - frame / 2.0).length() / (frame.length() / 2.0);
        let sky = |day: &Day| day.sky(towards);
        let (mut sky_clean, mut sky_own) = (None, None);
        let (mut photo, mut clean, mut covered) = (Vec3::ZERO, Vec3::ZERO, false);
        for (k, offset) in SAMPLES.into_iter().enumerate() {
            let at = corner + offset;
            let d = self.ray(at);
            let transient = self.crowd.at(at, frame.x, frame.y);
            let (plain, own) = match self.world.closest(self.shot.eye, d) {
                None => {
                    let plain = *sky_clean.get_or_insert_with(|| sky(&self.canonical.day));
                    let own = if self.photo_light.own_day {
                        *sky_own.get_or_insert_with(|| sky(&self.photo_light.day))
                    } else {
                        plain
                    };
                    (plain, own)
                }
                Some(hit) => {
                    let spot = self.world.spot(self.shot.eye, d, &hit, 1.0 / camera.fx, k);
                    let plain = self.world.radiance(&spot, &self.canonical.day, self.suns.0[k], hit.t);
                    let own = if self.photo_light.own_day && transient.is_none() {
                        self.world.radiance(&spot, &self.photo_light.day, self.suns.1[k], hit.t)
                    } else {
                        plain
                    };
                    (plain, own)
                }
            };
            clean += self.canonical.expose(plain, edge);
            photo += match transient {
                Some((albedo, light)) => {
                    covered = true;
                    self.photo_light.expose(radiance(&self.photo_light.day, albedo, light), edge)
                }
                None => self.photo_light.expose(own, edge),
            };
        }
        Pixel {
            photo: self.photo_light.encode(photo / 4.0),
            clean: self.canonical.encode(clean / 4.0),
            depth,
            part,
            covered,
        }
    }
}
