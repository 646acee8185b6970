//! The solids with their names, and what a ray finds among them.

use crate::bvh::Bvh;
use crate::light::{Day, open_samples};
use crate::material::Material;
use crate::shape::{SolidShape, Surface};
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// What an instance is good for in a protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ObjectKind {
    /// One connected thing that a click can name.
    Object,
    /// Several alike things under one name, such as a row of columns.
    Group,
    /// Background and structure: ground, walls, trees, hills.
    Surface,
}

/// A named thing of the scene. Its id is its index; 0 is the sky.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Instance {
    /// Name, such as `left_pavilion`.
    pub name: String,
    /// What it is good for.
    pub kind: ObjectKind,
}

/// A named part of an instance. Its id is its index; 0 is the sky.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorldPart {
    /// Name, such as `roof`; unique within its instance.
    pub name: String,
    /// Id of the instance it belongs to.
    pub instance: u16,
}

/// A ray's find.
#[derive(Clone, Copy, Debug)]
pub struct RayHit {
    /// Distance along the ray.
    pub t: f32,
    /// Index of the solid; `None` is the ground.
    pub solid: Option<usize>,
}

/// What all light has in common at a point of a surface.
#[derive(Clone, Copy, Debug)]
pub struct SurfaceSpot {
    /// The point, lifted off the surface.
    pub lifted: Vec3,
    /// Albedo, linear.
    pub albedo: Vec3,
    /// Shading normal.
    pub normal: Vec3,
    /// How much of the sky the sample's direction sees.
    pub open: f32,
}

/// The whole scene in its own units: about 12 across, the gate's axis at x = 0, its columns at y = 0.
#[derive(Clone, Debug)]
pub struct SyntheticWorld {
    /// The solids.
    pub shapes: Vec<SolidShape>,
    /// Part of each solid.
    pub part_of: Vec<u16>,
    /// Material of each solid: index into `materials`.
    pub material_of: Vec<u16>,
    /// The materials.
    pub materials: Vec<Material>,
    /// The instances.
    pub instances: Vec<Instance>,
    /// The parts.
    pub parts: Vec<WorldPart>,
    /// Material of the ground.
    pub ground: u16,
    /// Part of the ground.
    pub ground_part: u16,
    /// The point at which cameras are aimed.
    pub centre: Vec3,
    /// Distance from which the whole scene fills a photo.
    pub distance: f32,
    /// Distance over which haze takes over.
    pub haze: f32,
    /// The hierarchy over `shapes`.
    pub bvh: Bvh,
}

/// Farthest that anything is seen.
const FAR: f32 = 1e4;
/// Reach of the rays that distinguish corners from open ground.
const OPEN_REACH: f32 = 0.9;

impl SyntheticWorld {
    /// Nearest surface along a ray.
    pub fn closest(&self, o: Vec3, d: Vec3) -> Option<RayHit> {
        let ground = if d.z < -1e-6 && o.z > 0.0 { -o.z / d.z } else { FAR };
        let most = ground.min(FAR);
        match self.bvh.closest(&self.shapes, o, d, 1e-4, most) {
            Some((solid, t)) => Some(RayHit { t, solid: Some(solid) }),
            None if ground < FAR => Some(RayHit { t: ground, solid: None }),
            None => None,
        }
    }

    /// The scene with one instance only, and the ground.
    pub fn alone(&self, instance: u16) -> SyntheticWorld {
        self.with_instances(|other| other == instance)
    }

    /// The scene without an instance.
    pub fn without(&self, instance: u16) -> SyntheticWorld {
        self.with_instances(|other| other != instance)
    }

    /// The ground, and the instances for which `stays` holds.
    fn with_instances(&self, stays: impl Fn(u16) -> bool) -> SyntheticWorld {
        let is_of = |i: &usize| stays(self.parts[usize::from(self.part_of[*i])].instance);
        let keep: Vec<usize> = (0..self.shapes.len()).filter(is_of).collect();
        let mut world = SyntheticWorld {
            shapes: keep.iter().map(|&i| self.shapes[i].clone()).collect(),
            part_of: keep.iter().map(|&i| self.part_of[i]).collect(),
            material_of: keep.iter().map(|&i| self.material_of[i]).collect(),
            ..self.clone()
        };
        world.bvh = Bvh::new(&world.shapes);
        world
    }

    /// Whether nothing stands between two points, the last `slack` of the way aside.
    pub fn sees(&self, from: Vec3, to: Vec3, slack: f32) -> bool {
        let (way, length) = ((to - from).normalize_or(Vec3::X), (to - from).length());
        self.closest(from, way).is_none_or(|hit| hit.t > length - slack)
    }

    /// Part of a hit.
    pub fn part(&self, hit: &RayHit) -> u16 {
        hit.solid.map_or(self.ground_part, |i| self.part_of[i])
    }

    /// The surface at a hit, ready to be lit; `sample` picks which direction probes for corners.
    pub fn spot(&self, o: Vec3, d: Vec3, hit: &RayHit, pixel: f32, sample: usize) -> SurfaceSpot {
        let p = o + d * hit.t;
        let (surface, material) = match hit.solid {
            Some(i) => (self.shapes[i].surface(p), self.material_of[i]),
            None => (Surface { normal: Vec3::Z, uv: p.truncate(), flat: true }, self.ground),
        };
        let slant = surface.normal.dot(-d).abs().max(0.15);
        let footprint = hit.t * pixel / slant.sqrt();
        let (albedo, normal) = self.materials[material as usize].at(p, &surface, footprint);
        let outward = if surface.normal.dot(d) > 0.0 { -surface.normal } else { surface.normal };
        let lifted = p + outward * (1e-3 + 2e-4 * hit.t);
        let probe = open_samples(outward)[sample];
        let open = match self.bvh.closest(&self.shapes, lifted, probe, 1e-4, OPEN_REACH) {
            Some((_, t)) => t / OPEN_REACH,
            None if probe.z < 0.0 => (lifted.z / -probe.z / OPEN_REACH).min(1.0),
            None => 1.0,
        };
        SurfaceSpot { lifted, albedo, normal, open }
    }

    /// Radiance towards the camera of a spot at distance `t`, under a day's light with the sun at `sun`.
    pub fn radiance(&self, spot: &SurfaceSpot, day: &Day, sun: Vec3, t: f32) -> Vec3 {
        let lit =
            spot.normal.dot(day.sun) > 0.0 && !self.bvh.blocked(&self.shapes, spot.lifted, sun, 1e-3, FAR);
        let out = day.shade(spot.albedo, spot.normal, if lit { 1.0 } else { 0.0 }, spot.open);
        day.veil(out, t, self.haze)
    }

    /// Part of the surface nearest to a point, and the distance to that surface. A point inside a solid belongs to
    /// it: faces that are buried in other solids, such as a foot in the ground, are no surface.
    pub fn nearest(&self, p: Vec3) -> (u16, f32) {
        let (mut part, mut best) = (self.ground_part, p.z);
        for (shape, &of) in self.shapes.iter().zip(&self.part_of) {
            let (low, high) = shape.bounds();
            if (low - p).max(p - high).max(Vec3::ZERO).length() > best.max(0.0) {
                continue;
            }
            let distance = shape.distance(p);
            if distance < best {
                (part, best) = (of, distance);
            }
        }
        (part, best.abs())
    }
}
