//! What surrounds the buildings, and the wall at their back.

use crate::builder::Builder;
use crate::material::{Material, colour};
use crate::random::Rng;
use crate::shape::SolidShape;
use crate::world::ObjectKind;
use glam::Vec3;

/// A bright wall close to the hall's back: lower and narrower than it, so that no photo from the front sees it.
pub fn occluded_wall(b: &mut Builder, rng: &mut Rng, hall: Vec3) {
    let hue = [[0x2f8f9d, 0xe8b23a], [0xb23a6a, 0xe8e0c8], [0x3f9f5a, 0xd8d060]][rng.below(3)];
    let mosaic = b.material(Material::Mosaic { a: colour(hue[0]), b: colour(hue[1]), size: 0.42 });
    b.instance("occluded_wall", ObjectKind::Surface);
    b.part("wall");
    let size = Vec3::new(hall.x * rng.range(0.95, 1.15), 0.22, hall.z * rng.range(0.42, 0.55));
    b.add(SolidShape::block(Vec3::new(0.0, hall.y + 0.36, 0.0), size, 0.0), mosaic);
}

/// Trees at the sides of a gate of half width `half`, hedges, and hills in the far background.
pub fn landscape(b: &mut Builder, rng: &mut Rng, half: f32) {
    let trunk = b.material(Material::Marble { base: colour(0x6a5238), vein: colour(0x3d2e20), size: 0.2 });
    let leaves =
        [0x4f7433, 0x3c6238, 0x6a8440, 0x2f5536].map(|c| b.material(Material::Foliage { base: colour(c) }));
    b.instance("trees", ObjectKind::Surface);
    b.part("trees");
    for side in [-1.0, 1.0] {
        for i in 0..7 {
            let along = i as f32 + rng.range(-0.25, 0.25);
            let x = side * (half + 7.6 + rng.range(0.0, 1.2) + 0.35 * along);
            let foot = Vec3::new(x, -1.0 + 2.3 * along, 0.0);
            let leaf = leaves[rng.below(2) + 2 * usize::from(i % 2 == 0)];
            let tall = rng.range(2.6, 4.0);
            b.add(SolidShape::Capsule { a: foot, b: foot + Vec3::Z * tall * 0.5, radius: 0.13 }, trunk);
            if i % 2 == 0 {
                let radii = Vec3::new(tall * 0.17, tall * 0.17, tall * 0.5);
                let centre = foot + Vec3::Z * (tall * 0.62);
                b.add(SolidShape::Ellipsoid { centre, radii, to_local: glam::Mat3::IDENTITY }, leaf);
                continue;
            }
            for k in 0..6 {
                let angle = std::f32::consts::TAU * k as f32 / 5.0 + along;
                let out = if k == 5 { 0.0 } else { tall * 0.2 };
                let lift = if k == 5 { 0.86 } else { rng.range(0.58, 0.74) };
                let centre = foot + Vec3::new(angle.cos() * out, angle.sin() * out, tall * lift);
                b.add(SolidShape::ball(centre, tall * rng.range(0.17, 0.23)), leaf);
            }
        }
    }
    b.part("hedges");
    for side in [-1.0, 1.0] {
        for y in [-9.0, -5.6] {
            let foot = Vec3::new(side * (half + 3.6), y, 0.0);
            b.add(SolidShape::block(foot, Vec3::new(2.6, 0.5, 0.42), 0.0), leaves[1]);
        }
    }
    b.instance("hills", ObjectKind::Surface);
    b.part("hills");
    for i in 0..14 {
        let angle = std::f32::consts::TAU * (i as f32 + rng.range(-0.3, 0.3)) / 14.0;
        let distance = rng.range(75.0, 110.0);
        let slope = colour([0x5d7350, 0x6a7a58, 0x546c54][rng.below(3)]);
        let material = b.material(Material::Slope { base: slope });
        let radii = Vec3::new(rng.range(26.0, 38.0), rng.range(26.0, 38.0), rng.range(5.0, 13.0));
        let centre = Vec3::new(angle.sin() * distance, angle.cos() * distance, -1.0);
        b.add(SolidShape::Ellipsoid { centre, radii, to_local: glam::Mat3::IDENTITY }, material);
    }
}
