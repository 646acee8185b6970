//! A whole set in memory, and what is true of positions in it.

use crate::cameras::CameraShot;
use crate::options::SyntheticOptions;
use crate::photo::SyntheticPhoto;
use crate::points::SyntheticPoint;
use crate::trace::expose;
use crate::transient::Crowd;
use crate::world::{Instance, ObjectKind, SyntheticWorld, WorldPart};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use segwild_scene::{Image, Mask, Pose, SceneFrame};

/// A whole set in memory.
#[derive(Clone, Debug)]
pub struct SyntheticScene {
    /// The options that it was made with.
    pub options: SyntheticOptions,
    /// The named things; an id is an index, 0 is the sky.
    pub instances: Vec<Instance>,
    /// The parts of all instances; an id is an index, 0 is the sky.
    pub parts: Vec<WorldPart>,
    /// The photos, training and test mixed, in the order of the numbers in their names.
    pub photos: Vec<SyntheticPhoto>,
    /// The points a reconstruction would have.
    pub points: Vec<SyntheticPoint>,
    pub(crate) world: SyntheticWorld,
}

impl SyntheticScene {
    /// Id of the instance of that name.
    pub fn instance_named(&self, name: &str) -> Option<u16> {
        self.instances.iter().position(|i| i.name == name).map(|i| i as u16)
    }

    /// Ids of the instances that one click can name.
    pub fn objects(&self) -> Vec<u16> {
        let is_object = |i: &u16| self.instances[usize::from(*i)].kind == ObjectKind::Object;
        (0..self.instances.len() as u16).filter(is_object).collect()
    }

    /// The pixels that an instance would cover on every photo if only the ground stood there with it, in the order of
    /// the photos.
    pub fn amodal(&self, instance: u16) -> Vec<Mask> {
        let world = self.world.alone(instance);
        let amodal_mask = |photo: &SyntheticPhoto| {
            let eye = photo.pose.centre() / self.options.units as f32;
            let back = photo.pose.rotation.transpose();
            Mask::from_fn(photo.camera.width, photo.camera.height, |x, y| {
                let towards = back * photo.camera.ray(glam::Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
                world.closest(eye, towards.normalize()).is_some_and(|hit| hit.solid.is_some())
            })
        };
        self.photos.par_iter().map(amodal_mask).collect()
    }

    /// What each photo would show without an instance and without transients, under the light of the photo, in the order of the
    /// photos. Where `chosen` is false for a photo's index, `None`.
    pub fn without(&self, instance: u16, chosen: impl Fn(usize) -> bool) -> Vec<Option<Image>> {
        let world = self.world.without(instance);
        let traced = |photo: &SyntheticPhoto| {
            let units = self.options.units as f32;
            let pose = Pose { translation: photo.pose.translation / units, ..photo.pose };
            let shot = CameraShot { camera: photo.camera, pose, eye: pose.centre(), front: photo.front };
            expose(&world, &shot, &photo.photo_light, &Crowd::default()).photo
        };
        self.photos.iter().enumerate().map(|(i, photo)| chosen(i).then(|| traced(photo))).collect()
    }

    /// Part of the surface nearest to a position in file units, and the distance to that surface in file units; a
    /// position inside a solid belongs to that solid.
    pub fn nearest_part(&self, position: DVec3) -> (u16, f64) {
        let (part, distance) = self.world.nearest((position / self.options.units).as_vec3());
        (part, f64::from(distance) * self.options.units)
    }

    /// Instance of the surface nearest to a position in file units, and the distance to it in file units.
    pub fn nearest_instance(&self, position: DVec3) -> (u16, f64) {
        let (part, distance) = self.nearest_part(position);
        (self.parts[usize::from(part)].instance, distance)
    }

    /// Instances of the surfaces nearest to positions in a scene's normalised frame.
    pub fn label(&self, frame: &SceneFrame, positions: &[[f32; 3]]) -> Vec<u16> {
        let one =
            |p: &[f32; 3]| self.nearest_instance(Vec3::from(*p).as_dvec3() * frame.scale + frame.origin).0;
        positions.par_iter().map(one).collect()
    }
}
