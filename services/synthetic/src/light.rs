//! Sun, sky and what a camera makes of them.

use crate::random::{Rng, fbm};
use glam::{Mat3, Vec2, Vec3};

/// The light on a day. Radiances are linear; 1 is roughly white paper in the sun.
#[derive(Clone, Debug, PartialEq)]
pub struct Day {
    /// Towards the sun; length 1.
    pub sun: Vec3,
    /// Radiance of the sun.
    pub sun_colour: Vec3,
    /// Radiance from above.
    pub ambient: Vec3,
    /// Sky straight up.
    pub zenith: Vec3,
    /// Sky at the horizon; also the haze.
    pub horizon: Vec3,
    /// Share of the sky under clouds, in [0, 1].
    pub clouds: f32,
    /// Which clouds.
    pub drift: Vec2,
}

impl Day {
    /// The light of every clean image.
    pub fn canonical() -> Day {
        Day {
            sun: Vec3::new(-0.58, -0.62, 0.62).normalize(),
            sun_colour: Vec3::new(2.15, 1.90, 1.50),
            ambient: Vec3::new(0.36, 0.42, 0.54),
            zenith: Vec3::new(0.10, 0.24, 0.60),
            horizon: Vec3::new(0.62, 0.80, 1.02),
            clouds: 0.42,
            drift: Vec2::new(3.7, 1.3),
        }
    }

    /// Another day and hour; `strength` 0 is the canonical day.
    pub fn random(rng: &mut Rng, strength: f32) -> Day {
        let plain = Day::canonical();
        let (azimuth, height) = (rng.range(-1.45, 1.45), rng.range(0.30, 1.15));
        let sun = Vec3::new(azimuth.sin() * height.cos(), -azimuth.cos() * height.cos(), height.sin());
        // Low suns are warm; a cloudy day has little sun and a grey sky.
        let low = ((0.75 - height) / 0.45).clamp(0.0, 1.0);
        let grey = if rng.chance(0.25) { rng.range(0.6, 1.0) } else { rng.range(0.0, 0.25) };
        let warmth = Vec3::new(1.0 + 0.12 * low, 1.0 - 0.16 * low, 1.0 - 0.48 * low);
        let cast = rng.range(-0.08, 0.08);
        let cast = Vec3::new(1.0 + cast, 1.0, 1.0 - cast);
        let dull = Vec3::splat(0.62);
        let day = Day {
            sun,
            sun_colour: plain.sun_colour * warmth * (1.0 - 0.85 * grey) * cast,
            ambient: plain.ambient.lerp(Vec3::splat(0.62), grey) * cast * rng.range(0.85, 1.15),
            zenith: plain.zenith.lerp(dull, 0.85 * grey) * (1.0 - 0.25 * low),
            horizon: plain
                .horizon
                .lerp(Vec3::new(0.98, 0.66, 0.42), 0.7 * low * (1.0 - grey))
                .lerp(dull, 0.8 * grey),
            clouds: rng.range(0.1, 0.75).max(grey),
            drift: Vec2::new(rng.range(0.0, 40.0), rng.range(0.0, 40.0)),
        };
        let to = |a: Vec3, b: Vec3| a + (b - a) * strength;
        Day {
            sun: to(plain.sun, day.sun).normalize_or(plain.sun),
            sun_colour: to(plain.sun_colour, day.sun_colour).max(Vec3::ZERO),
            ambient: to(plain.ambient, day.ambient).max(Vec3::splat(0.05)),
            zenith: to(plain.zenith, day.zenith).max(Vec3::splat(0.02)),
            horizon: to(plain.horizon, day.horizon).max(Vec3::splat(0.02)),
            clouds: (plain.clouds + (day.clouds - plain.clouds) * strength).clamp(0.0, 1.0),
            drift: if strength > 0.0 { day.drift } else { plain.drift },
        }
    }

    /// Radiance of the sky in a direction.
    pub fn sky(&self, d: Vec3) -> Vec3 {
        let up = d.z.max(0.0);
        let blue = self.horizon.lerp(self.zenith, 1.0 - (1.0 - up).powi(4));
        let glow = d.dot(self.sun).max(0.0).powi(24) * 0.35;
        let clear = blue + self.sun_colour * glow * (1.0 - self.clouds * 0.7);
        let plane = Vec2::new(d.x, d.y) / (up + 0.12);
        let q = (plane * 1.1 + self.drift).extend(0.0);
        let puff = fbm(q, 5, 0.0) + 0.5;
        let body = fbm(q + (self.sun * 0.25).with_z(0.0), 3, 0.0) + 0.5;
        let cover =
            ((puff - 0.72 + 0.42 * self.clouds) * 4.5).clamp(0.0, 1.0) * ((up - 0.02) * 9.0).clamp(0.0, 1.0);
        let bright = self.ambient * 0.9 + self.sun_colour * 0.28;
        let white = bright * (1.0 - 0.55 * (body - 0.45).clamp(0.0, 0.5));
        clear.lerp(white, 0.92 * cover)
    }

    /// Radiance that leaves a matt surface. `sunlit` and `open` in [0, 1]: how much of the sun and of the sky
    /// reaches it.
    pub fn shade(&self, albedo: Vec3, normal: Vec3, sunlit: f32, open: f32) -> Vec3 {
        let direct = self.sun_colour * (normal.dot(self.sun).max(0.0) * sunlit);
        let up = 0.5 + 0.5 * normal.z;
        let bounce = (self.sun_colour * self.sun.z * 0.5 + self.ambient) * Vec3::new(0.34, 0.31, 0.26);
        albedo * (direct + (self.ambient * up + bounce * (1.0 - up)) * (0.25 + 0.75 * open))
    }

    /// Haze over a distance.
    pub fn veil(&self, radiance: Vec3, distance: f32, haze: f32) -> Vec3 {
        radiance.lerp(self.horizon * 0.9, 1.0 - (-distance / haze).exp())
    }
}

/// What one camera and one hand at the slider did to a photo.
#[derive(Clone, Debug, PartialEq)]
pub struct PhotoLight {
    /// The light of its day.
    pub day: Day,
    /// Whether the day is not the canonical one.
    pub own_day: bool,
    /// Stops of exposure.
    pub exposure: f32,
    /// Exponent on the encoded colour.
    pub gamma: f32,
    /// Light lost in the corners, in [0, 1].
    pub vignette: f32,
    /// NeRF-W's affine colour, applied last: scale.
    pub scale: Vec3,
    /// NeRF-W's affine colour: shift.
    pub shift: Vec3,
}

impl PhotoLight {
    /// The appearance of every clean image.
    pub fn canonical() -> PhotoLight {
        PhotoLight {
            day: Day::canonical(),
            own_day: false,
            exposure: 0.0,
            gamma: 1.0,
            vignette: 0.0,
            scale: Vec3::ONE,
            shift: Vec3::ZERO,
        }
    }

    /// What the film keeps of a radiance, linear in [0, 1); `edge` is 0 in the middle of the photo and 1 in its
    /// corners.
    pub fn expose(&self, radiance: Vec3, edge: f32) -> Vec3 {
        let light = radiance * (self.exposure.exp2() * (1.0 - self.vignette * edge * edge));
        // Narkowicz's fit of the ACES film curve.
        let x = light.max(Vec3::ZERO) * 0.62;
        let (up, down) = (x * (x * 2.51 + 0.03), x * (x * 2.43 + 0.59) + 0.14);
        (up / down).min(Vec3::ONE)
    }

    /// sRGB value in [0, 1] of a pixel's mean exposure.
    pub fn encode(&self, exposed: Vec3) -> Vec3 {
        let encoded = exposed.max(Vec3::ZERO).powf(self.gamma / 2.2);
        (encoded * self.scale + self.shift).clamp(Vec3::ZERO, Vec3::ONE)
    }
}

/// Offsets over the sun's disc for a pixel's samples: together a soft edge to every shadow.
pub fn sun_samples(sun: Vec3) -> [Vec3; 4] {
    let side = sun.cross(Vec3::Z).normalize_or(Vec3::X);
    let up = side.cross(sun);
    [(-0.9, -0.35), (0.35, -0.9), (-0.35, 0.9), (0.9, 0.35)]
        .map(|(a, b)| (sun + (side * a + up * b) * 0.022).normalize())
}

/// Directions around a normal that stand for the open sky, one per sample of a pixel.
pub fn open_samples(normal: Vec3) -> [Vec3; 4] {
    let helper = if normal.z.abs() > 0.9 { Vec3::X } else { Vec3::Z };
    let side = normal.cross(helper).normalize_or(Vec3::X);
    let frame = Mat3::from_cols(side, normal.cross(side), normal);
    [(0.80, 0.10), (-0.05, 0.75), (-0.70, -0.10), (0.10, -0.78)]
        .map(|(a, b): (f32, f32)| frame * Vec3::new(a, b, (1.0f32 - a * a - b * b).sqrt()))
}
