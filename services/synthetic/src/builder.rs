//! Collects the solids of a world, one named thing and part after the other.

use crate::bvh::Bvh;
use crate::material::Material;
use crate::shape::SolidShape;
use crate::world::{Instance, ObjectKind, SyntheticWorld, WorldPart};
use glam::Vec3;

/// Collects solids under the current part's name.
pub struct Builder {
    /// What was collected so far.
    pub world: SyntheticWorld,
}

impl Builder {
    /// An empty world, its ground still without a material.
    pub fn new() -> Builder {
        Builder {
            world: SyntheticWorld {
                shapes: Vec::new(),
                part_of: Vec::new(),
                material_of: Vec::new(),
                materials: Vec::new(),
                instances: Vec::new(),
                parts: Vec::new(),
                ground: 0,
                ground_part: 1,
                centre: Vec3::new(0.0, 1.2, 1.9),
                distance: 11.5,
                haze: 190.0,
                bvh: Bvh::new(&[]),
            },
        }
    }

    /// Starts a named thing.
    pub fn instance(&mut self, name: &str, kind: ObjectKind) {
        self.world.instances.push(Instance { name: name.into(), kind });
    }

    /// Starts a part of the current thing.
    pub fn part(&mut self, name: &str) -> u16 {
        let instance = (self.world.instances.len() - 1) as u16;
        self.world.parts.push(WorldPart { name: name.into(), instance });
        (self.world.parts.len() - 1) as u16
    }

    /// Registers a material.
    pub fn material(&mut self, material: Material) -> u16 {
        self.world.materials.push(material);
        (self.world.materials.len() - 1) as u16
    }

    /// Adds a solid to the current part.
    pub fn add(&mut self, shape: SolidShape, material: u16) {
        let part = (self.world.parts.len() - 1) as u16;
        self.world.shapes.push(shape);
        self.world.part_of.push(part);
        self.world.material_of.push(material);
    }

    /// Adds several solids.
    pub fn add_all(&mut self, shapes: Vec<SolidShape>, material: u16) {
        for shape in shapes {
            self.add(shape, material);
        }
    }

    /// Gives the ground its material.
    pub fn ground(&mut self, material: Material) {
        self.world.ground = self.material(material);
    }

    /// The world, ready for rays.
    pub fn finish(mut self) -> SyntheticWorld {
        self.world.bvh = Bvh::new(&self.world.shapes);
        self.world
    }
}
