//! People and vehicles that stand in front of one photo only.

use crate::light::Day;
use crate::material::colour;
use crate::random::{Rng, hash_unit};
use glam::{Vec2, Vec3};

/// What a billboard shows, in its own frame: x across in units of its height, y from the foot (0) to the top (1).
#[derive(Clone, Debug, PartialEq)]
enum BillboardShape {
    Person { shirt: Vec3, stripe: Vec3, trousers: Vec3, skin: Vec3, hair: Vec3, bag: bool, arm: f32 },
    Vehicle { paint: Vec3, trim: Vec3, tall: bool },
}

/// One billboard on a photo.
#[derive(Clone, Debug, PartialEq)]
struct Billboard {
    figure: BillboardShape,
    /// Across the frame, in frame widths.
    x: f32,
    /// Height of the foot below the frame's top, in frame heights, for a billboard of scale 1.
    foot: f32,
    /// Height relative to its fellows.
    size: f32,
    mirrored: bool,
}

/// The transients of one photo.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Crowd {
    billboards: Vec<Billboard>,
    scale: f32,
}

impl Crowd {
    /// One to three transients that together cover `share` of a frame; none for a share of 0.
    pub fn random(rng: &mut Rng, share: f32, width: u32, height: u32) -> Crowd {
        if share <= 0.0 {
            return Crowd::default();
        }
        let count = 1 + rng.below(3);
        let mut slots: Vec<f32> =
            (0..count).map(|i| (i as f32 + rng.range(0.15, 0.85)) / count as f32).collect();
        if rng.chance(0.5) {
            slots.reverse();
        }
        let billboards = slots
            .into_iter()
            .map(|x| {
                let person = rng.chance(0.65);
                Billboard {
                    figure: if person { person_of(rng) } else { vehicle_of(rng) },
                    x,
                    foot: rng.range(0.93, 1.12),
                    size: if person { rng.range(0.85, 1.15) } else { rng.range(0.5, 0.7) },
                    mirrored: rng.chance(0.5),
                }
            })
            .collect();
        let mut crowd = Crowd { billboards, scale: 1.0 };
        let (mut low, mut high) = (0.02, 8.0);
        for _ in 0..18 {
            crowd.scale = (low + high) / 2.0;
            if crowd.share(width, height) < share { low = crowd.scale } else { high = crowd.scale }
        }
        crowd
    }

    /// Share of the frame covered, on a coarse grid.
    fn share(&self, width: u32, height: u32) -> f32 {
        const GRID: u32 = 72;
        let at = |i: u32, n: u32| (i as f32 + 0.5) / GRID as f32 * n as f32;
        let covered = (0..GRID * GRID)
            .filter(|i| {
                let p = Vec2::new(at(i % GRID, width), at(i / GRID, height));
                self.at(p, width as f32, height as f32).is_some()
            })
            .count();
        covered as f32 / (GRID * GRID) as f32
    }

    /// Albedo of the transient at a pixel position, and how much light it gets there.
    pub fn at(&self, p: Vec2, width: f32, height: f32) -> Option<(Vec3, f32)> {
        // The last billboard stands in front.
        self.billboards.iter().rev().find_map(|b| {
            let tall = b.size * self.scale * height;
            // Large figures are near: their feet drop out of the frame.
            let foot = height * (b.foot + 0.25 * (b.size * self.scale - 0.6).max(0.0));
            let mut q = Vec2::new((p.x - b.x * width) / tall, (foot - p.y) / tall);
            if b.mirrored {
                q.x = -q.x;
            }
            b.figure.at(q).map(|albedo| (albedo, 0.62 + 0.3 * q.y + 0.35 * q.x))
        })
    }
}

/// Radiance of a transient under a day's light.
pub fn radiance(day: &Day, albedo: Vec3, light: f32) -> Vec3 {
    albedo * (day.sun_colour * 0.42 * light + day.ambient * 0.75)
}

fn person_of(rng: &mut Rng) -> BillboardShape {
    const SHIRTS: [u32; 8] = [0xc23b30, 0x2f5fa8, 0xe0b83c, 0x3f8f5a, 0xf0f0ec, 0x232830, 0xd678a0, 0x58a6b8];
    const TROUSERS: [u32; 5] = [0x2a3550, 0x3b3b3b, 0x8a7654, 0x6b7480, 0x1e2226];
    const SKINS: [u32; 4] = [0xe6b998, 0xc68a5e, 0x8d5a3a, 0xf0cbb0];
    const HAIRS: [u32; 4] = [0x2a1d14, 0x5a3a1e, 0xb08a4a, 0x8a8a88];
    BillboardShape::Person {
        shirt: colour(SHIRTS[rng.below(8)]),
        stripe: colour(SHIRTS[rng.below(8)]),
        trousers: colour(TROUSERS[rng.below(5)]),
        skin: colour(SKINS[rng.below(4)]),
        hair: colour(HAIRS[rng.below(4)]),
        bag: rng.chance(0.5),
        arm: rng.range(-0.05, 0.28),
    }
}

fn vehicle_of(rng: &mut Rng) -> BillboardShape {
    const PAINTS: [u32; 6] = [0xb3271e, 0xf2c230, 0x2d6f9e, 0xe8e8e4, 0x3a8a54, 0x30343a];
    BillboardShape::Vehicle {
        paint: colour(PAINTS[rng.below(6)]),
        trim: colour(PAINTS[rng.below(6)]),
        tall: rng.chance(0.4),
    }
}

fn stroke(q: Vec2, a: Vec2, b: Vec2, radius: f32) -> bool {
    let (pa, ba) = (q - a, b - a);
    let h = (pa.dot(ba) / ba.length_squared()).clamp(0.0, 1.0);
    (pa - ba * h).length() < radius
}

fn oval(q: Vec2, centre: [f32; 2], radii: [f32; 2]) -> bool {
    ((q - Vec2::from(centre)) / Vec2::from(radii)).length_squared() < 1.0
}

fn slab(q: Vec2, x: (f32, f32), y: (f32, f32)) -> bool {
    q.x > x.0 && q.x < x.1 && q.y > y.0 && q.y < y.1
}

impl BillboardShape {
    fn at(&self, q: Vec2) -> Option<Vec3> {
        if q.y < -0.02 || q.y > 1.02 || q.x.abs() > 1.4 {
            return None;
        }
        let grain = 0.9 + 0.2 * hash_unit((q.x * 90.0) as i32, (q.y * 90.0) as i32, 1);
        match self {
            BillboardShape::Person { shirt, stripe, trousers, skin, hair, bag, arm } => {
                let v = |x: f32, y: f32| Vec2::new(x, y);
                let cloth =
                    if (q.y * 26.0).rem_euclid(2.0) < 1.0 { *shirt } else { shirt.lerp(*stripe, 0.8) };
                let body = if *bag && stroke(q, v(-0.10, 0.66), v(-0.12, 0.52), 0.075) {
                    *stripe * 0.6
                } else if oval(q, [0.0, 0.945], [0.058, 0.05]) && q.y > 0.935 - q.x * 0.3 {
                    *hair
                } else if oval(q, [0.0, 0.92], [0.052, 0.068]) || stroke(q, v(0.0, 0.84), v(0.0, 0.88), 0.028)
                {
                    *skin
                } else if stroke(q, v(0.13, 0.78), v(0.17 + arm * 0.2, 0.66), 0.038)
                    || stroke(q, v(-0.13, 0.78), v(-0.16, 0.62), 0.036)
                {
                    cloth * 0.85
                } else if stroke(q, v(0.17 + arm * 0.2, 0.66), v(0.14 + arm, 0.56 + arm), 0.027)
                    || stroke(q, v(-0.16, 0.62), v(-0.13, 0.47), 0.026)
                {
                    *skin
                } else if stroke(q, v(-0.085, 0.77), v(0.085, 0.77), 0.055)
                    || oval(q, [0.0, 0.63], [0.125, 0.18])
                {
                    cloth
                } else if stroke(q, v(-0.05, 0.47), v(-0.065, 0.08), 0.06)
                    || stroke(q, v(0.05, 0.47), v(0.075, 0.08), 0.06)
                {
                    *trousers
                } else if oval(q, [-0.085, 0.02], [0.075, 0.035]) || oval(q, [0.10, 0.02], [0.075, 0.035]) {
                    *hair * 0.7
                } else {
                    return None;
                };
                Some(body * grain)
            }
            BillboardShape::Vehicle { paint, trim, tall } => {
                let dark = Vec3::splat(0.02);
                let glass = Vec3::new(0.10, 0.14, 0.18);
                for wheel in [-0.62, 0.62] {
                    if oval(q, [wheel, 0.14], [0.155, 0.14]) {
                        let hub = oval(q, [wheel, 0.14], [0.075, 0.07]);
                        return Some(if hub { Vec3::splat(0.45) } else { dark });
                    }
                }
                let body = if *tall {
                    // A coach: high sides, a row of windows.
                    if !slab(q, (-1.08, 1.08), (0.12, 1.0)) {
                        return None;
                    }
                    let pane = (q.x + 1.08).rem_euclid(0.36);
                    if slab(q, (-1.02, 1.02), (0.55, 0.88)) && pane > 0.035 {
                        glass
                    } else if slab(q, (-1.08, 1.08), (0.30, 0.40)) {
                        *trim
                    } else {
                        *paint
                    }
                } else {
                    let cabin = q.y > 0.52 && q.y < 0.98 && q.x.abs() < 0.62 - (q.y - 0.52) * 0.55;
                    let hull = slab(q, (-1.05, 1.05), (0.13, 0.56)) && !(q.y > 0.48 && q.x.abs() > 1.0);
                    if cabin
                        && q.y > 0.57
                        && q.y < 0.90
                        && q.x.abs() < 0.53 - (q.y - 0.52) * 0.5
                        && q.x.abs() > 0.03
                    {
                        glass
                    } else if slab(q, (-1.05, -0.97), (0.32, 0.44)) || slab(q, (0.97, 1.05), (0.32, 0.44)) {
                        Vec3::new(0.8, 0.75, 0.5)
                    } else if cabin || hull {
                        if q.y < 0.2 { *paint * 0.5 } else { *paint }
                    } else {
                        return None;
                    }
                };
                Some(body * grain)
            }
        }
    }
}
