//! Scenes that the tests share.

use glam::Vec3;
use segwild_scene::{Camera, Image, Pose, Splats};

/// A small generator (splitmix64): the same numbers on every machine.
pub struct RasterTestRandom(pub u64);

impl RasterTestRandom {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in `from..to`.
    pub fn uniform(&mut self, from: f32, to: f32) -> f32 {
        from + (to - from) * ((self.next() >> 40) as f32 / (1u64 << 24) as f32)
    }

    pub fn vector<const N: usize>(&mut self, from: f32, to: f32) -> [f32; N] {
        std::array::from_fn(|_| self.uniform(from, to))
    }

    pub fn many(&mut self, count: usize, from: f32, to: f32) -> Vec<f32> {
        (0..count).map(|_| self.uniform(from, to)).collect()
    }

    pub fn image(&mut self, width: usize, height: usize, channels: usize) -> Image {
        Image { width, height, channels, data: self.many(width * height * channels, -1.0, 1.0) }
    }
}

/// A camera whose principal point is off the middle, and a pose that looks at the origin from the side.
pub fn view(width: u32, height: u32) -> (Camera, Pose) {
    let (w, h) = (width as f32, height as f32);
    let camera = Camera { width, height, fx: 1.1 * w, fy: 1.05 * w, cx: 0.47 * w, cy: 0.52 * h };
    (camera, Pose::look_at(Vec3::new(0.3, -0.4, -1.6), Vec3::new(0.02, 0.01, 0.0), Vec3::new(0.1, -1.0, 0.0)))
}

/// `count` splats in a ball in front of [`view`], some beyond its edges, with scales of `sizes`.
pub fn splats(random: &mut RasterTestRandom, count: usize, sizes: (f32, f32), sh_degree: u32) -> Splats {
    let basis = (sh_degree as usize + 1).pow(2);
    Splats {
        means: (0..count).map(|_| random.vector(-0.7, 0.7)).collect(),
        log_scales: (0..count).map(|_| random.vector(sizes.0.ln(), sizes.1.ln())).collect(),
        rotations: (0..count).map(|_| random.vector(-1.0, 1.0)).collect(),
        opacities: random.many(count, -3.0, 4.0),
        sh_degree,
        sh: random.many(count * basis * 3, -0.5, 0.5),
    }
}

/// Largest difference, relative to the largest expected number.
pub fn error(got: impl IntoIterator<Item = f32>, wanted: impl IntoIterator<Item = f64>) -> f64 {
    let (mut difference, mut largest) = (0f64, 1e-30f64);
    for (got, wanted) in got.into_iter().zip(wanted) {
        assert!(got.is_finite(), "a number is not finite: {got} where {wanted} is right");
        difference = difference.max((f64::from(got) - wanted).abs());
        largest = largest.max(wanted.abs());
    }
    difference / largest
}
