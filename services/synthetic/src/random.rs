//! Numbers from a seed, and smooth noise: the same on every machine and in every thread order.

use glam::{Vec2, Vec3};
use segwild_scene::split_mix;

/// SplitMix64 ([`split_mix`]): small, seedable, and each `(seed, stream)` is a sequence of its own, so that what one photo
/// draws never depends on another photo.
#[derive(Clone, Debug)]
pub struct Rng(u64);

impl Rng {
    /// The sequence of a seed's stream.
    pub fn new(seed: u64, stream: u64) -> Rng {
        let mut rng = Rng(seed ^ stream.wrapping_mul(0xd6e8_feb8_6659_fd93));
        rng.bits();
        rng.0 ^= stream.rotate_left(32);
        rng
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        split_mix(&mut self.0)
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u64 << 24) as f32
    }

    /// Uniform in [low, high).
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Three of [`Rng::range`].
    pub fn triple(&mut self, low: f32, high: f32) -> Vec3 {
        Vec3::new(self.range(low, high), self.range(low, high), self.range(low, high))
    }

    /// Uniform in `0..n`; `n` is at least 1.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.bits()) * n as u128) >> 64) as usize
    }

    /// True with probability `p`.
    pub fn chance(&mut self, p: f32) -> bool {
        self.unit() < p
    }

    /// Standard normal (Box-Muller).
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f32::consts::TAU * self.unit()).cos()
    }
}

/// 32 bits from a lattice point.
pub fn hash(x: i32, y: i32, z: i32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^ (h >> 15)
}

/// A lattice point's number in [0, 1).
pub fn hash_unit(x: i32, y: i32, z: i32) -> f32 {
    (hash(x, y, z) >> 8) as f32 / (1u32 << 24) as f32
}

/// Value noise in [0, 1] with features of size 1.
pub fn noise(p: Vec3) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let w = f * f * (Vec3::splat(3.0) - 2.0 * f);
    let (x, y, z) = (cell.x as i32, cell.y as i32, cell.z as i32);
    let edge = |dy: i32, dz: i32| {
        let (a, b) = (hash_unit(x, y + dy, z + dz), hash_unit(x + 1, y + dy, z + dz));
        a + (b - a) * w.x
    };
    let (e00, e10, e01, e11) = (edge(0, 0), edge(1, 0), edge(0, 1), edge(1, 1));
    let (near, far) = (e00 + (e10 - e00) * w.y, e01 + (e11 - e01) * w.y);
    near + (far - near) * w.z
}

/// Fractal noise around 0 in [-0.5, 0.5]: octaves finer than `footprint` (the size of a pixel on the surface,
/// in units of `p`) fade out, so that distant texture does not flicker from photo to photo.
pub fn fbm(p: Vec3, octaves: u32, footprint: f32) -> f32 {
    let (mut sum, mut weight, mut scale) = (0.0, 0.5, 1.0f32);
    for octave in 0..octaves {
        let kept = (1.5 - 2.0 * footprint * scale).clamp(0.0, 1.0);
        if kept <= 0.0 {
            break;
        }
        sum += weight * kept * (noise(p * scale + Vec3::splat(17.3 * octave as f32)) - 0.5);
        weight *= 0.5;
        scale *= 2.03;
    }
    sum
}

/// [`noise`] in the plane.
pub fn noise2(p: Vec2) -> f32 {
    noise(p.extend(0.5))
}
