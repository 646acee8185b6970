//! Procedural stone, metal and foliage: the albedo and the normal of a surface at a point.
//!
//! Every texture is a function of world or surface coordinates only, so that all photos agree on it, and is
//! filtered by the size of a pixel on the surface.

use crate::random::{fbm, hash_unit, noise, noise2};
use crate::shape::Surface;
use glam::{Vec2, Vec3};

/// A linear colour from an sRGB code such as `0xd9c4a0`.
pub fn colour(code: u32) -> Vec3 {
    let channel = |shift: u32| (((code >> shift) & 255) as f32 / 255.0).powf(2.2);
    Vec3::new(channel(16), channel(8), channel(0))
}

/// How a surface is coloured. Lengths are in world units, colours linear.
#[derive(Clone, Debug)]
pub enum Material {
    /// Courses of hewn blocks.
    Ashlar {
        /// Mean colour.
        base: Vec3,
        /// Width and height of a block.
        block: Vec2,
    },
    /// A hewn wall with a row of arched windows on its upright faces.
    Windows {
        /// Colour of the wall.
        base: Vec3,
        /// Colour of the panes.
        pane: Vec3,
        /// Distance from window to window.
        bay: f32,
        /// Heights of sill and arch top above the foot.
        rise: Vec2,
    },
    /// A square of flags in bands, lawn around it.
    Plaza {
        /// Colour of the flags.
        flag: Vec3,
        /// Colour of the bands.
        band: Vec3,
        /// Colour of the lawn.
        lawn: Vec3,
        /// Centre of the square.
        centre: Vec2,
        /// Half sides of the square.
        half: Vec2,
    },
    /// A column shaft with flutes and drums.
    Fluted {
        /// Mean colour.
        base: Vec3,
        /// Number of flutes.
        flutes: f32,
        /// Height of a drum.
        drum: f32,
    },
    /// Level stripes of two colours.
    Bands {
        /// First colour.
        a: Vec3,
        /// Second colour.
        b: Vec3,
        /// Height of a pair.
        period: f32,
    },
    /// A dome's shell: meridian ribs and rings.
    Ribbed {
        /// Colour of the panels.
        base: Vec3,
        /// Colour of the ribs.
        rib: Vec3,
        /// Number of ribs.
        ribs: f32,
    },
    /// A carved band: bars and rosettes.
    Frieze {
        /// Colour of the ground.
        base: Vec3,
        /// Colour of the carving.
        carved: Vec3,
        /// Length of one bar and one rosette.
        period: f32,
    },
    /// Roof tiles.
    Tiles {
        /// Mean colour.
        base: Vec3,
    },
    /// Veined stone.
    Marble {
        /// Colour of the stone.
        base: Vec3,
        /// Colour of the veins.
        vein: Vec3,
        /// Size of the pattern.
        size: f32,
    },
    /// Leaves.
    Foliage {
        /// Mean colour.
        base: Vec3,
    },
    /// Squares of two colours with a rosette in each.
    Mosaic {
        /// First colour.
        a: Vec3,
        /// Second colour.
        b: Vec3,
        /// Side of a square.
        size: f32,
    },
    /// A far wooded slope.
    Slope {
        /// Mean colour.
        base: Vec3,
    },
}

/// How much of a pixel a joint of `width` covers, for joints at the multiples of `period`.
fn joint(x: f32, period: f32, width: f32, footprint: f32) -> f32 {
    let distance = (x / period - (x / period).round()).abs() * period;
    let soft = footprint.max(width * 0.3);
    let inside = ((width / 2.0 + soft / 2.0 - distance) / soft).clamp(0.0, 1.0);
    inside * (width / footprint.max(1e-6)).min(1.0)
}

/// 1 below `edge`, 0 above, blurred over a pixel.
fn below(x: f32, edge: f32, footprint: f32) -> f32 {
    ((edge - x) / footprint.max(1e-4) + 0.5).clamp(0.0, 1.0)
}

fn mix(a: Vec3, b: Vec3, w: f32) -> Vec3 {
    a + (b - a) * w
}

/// Blocks laid in courses: colour factor of the block, and how much of the pixel is joint.
fn courses(uv: Vec2, block: Vec2, footprint: f32) -> (f32, f32) {
    let row = (uv.y / block.y).floor();
    let shifted = uv.x + block.x * 0.5 * (row.rem_euclid(2.0)) + block.x * 0.2 * hash_unit(row as i32, 7, 3);
    let column = (shifted / block.x).floor();
    let shade = hash_unit(column as i32, row as i32, 11) - 0.5;
    let fade = (1.4 - footprint / block.y).clamp(0.0, 1.0);
    let width = block.y * 0.09;
    let gap = joint(shifted, block.x, width, footprint).max(joint(uv.y, block.y, width, footprint));
    (shade * fade, gap * fade)
}

/// Dirt that runs down walls.
fn weather(p: Vec3, footprint: f32) -> f32 {
    fbm(Vec3::new(p.x * 2.2, p.y * 2.2, p.z * 0.5), 3, footprint * 2.2) * 0.35
        + fbm(p * 9.0, 3, footprint * 9.0) * 0.30
}

fn ashlar(base: Vec3, block: Vec2, p: Vec3, s: &Surface, footprint: f32) -> Vec3 {
    let (shade, gap) = courses(s.uv, block, footprint);
    let warm = Vec3::new(1.0 + 0.10 * shade, 1.0, 1.0 - 0.14 * shade);
    base * warm * (1.0 + 0.34 * shade + weather(p, footprint)) * (1.0 - 0.45 * gap)
}

impl Material {
    /// Linear albedo and shading normal at a point, for pixels of size `footprint` there.
    pub fn at(&self, p: Vec3, s: &Surface, footprint: f32) -> (Vec3, Vec3) {
        let rough = |amount: f32| 1.0 + weather(p, footprint) * amount;
        let albedo = match self {
            Material::Ashlar { base, block } => ashlar(*base, *block, p, s, footprint),
            Material::Windows { base, pane, bay, rise } => {
                let wall = ashlar(*base, Vec2::new(0.46, 0.22), p, s, footprint);
                if s.flat { wall } else { arch(wall, *base, *pane, *bay, *rise, s.uv, footprint) }
            }
            Material::Plaza { flag, band, lawn, centre, half } => {
                plaza([*flag, *band, *lawn], p.truncate() - *centre, *half, footprint)
            }
            Material::Fluted { base, flutes, drum } => {
                let size = footprint * flutes;
                let groove = if s.flat { 0.0 } else { (s.uv.x * flutes).cos() };
                let seam = joint(s.uv.y, *drum, 0.02, footprint);
                let drum_shade = hash_unit((s.uv.y / drum).floor() as i32, (p.x * 1.7) as i32, 5) - 0.5;
                let kept = (1.3 - size * 0.5).clamp(0.0, 1.0);
                *base * rough(0.9) * (1.0 + 0.16 * groove * kept + 0.16 * drum_shade) * (1.0 - 0.35 * seam)
            }
            Material::Bands { a, b, period } => {
                let phase = (s.uv.y / period).rem_euclid(1.0);
                let w = below((phase - 0.5).abs(), 0.25, footprint / period);
                let seam = joint(s.uv.x, std::f32::consts::TAU / 14.0, 0.05, footprint * 3.0);
                mix(*a, *b, w) * rough(1.0) * (1.0 - 0.22 * seam)
            }
            Material::Ribbed { base, rib, ribs } => {
                let phase = (s.uv.x * ribs / std::f32::consts::TAU).rem_euclid(1.0);
                let w = below((phase - 0.5).abs(), 0.09, footprint * ribs / 6.0);
                let panel = hash_unit((p.z / 0.18).floor() as i32, (s.uv.x * 7.0) as i32, 2) - 0.5;
                let ring = joint(p.z, 0.36, 0.025, footprint);
                mix(*base, *rib, w) * rough(0.9) * (1.0 + 0.10 * panel) * (1.0 - 0.3 * ring)
            }
            Material::Frieze { base, carved, period } => {
                frieze(*base, *carved, *period, s, footprint) * rough(0.7)
            }
            Material::Tiles { base } => {
                let row = (s.uv.y / 0.11).floor();
                let along = s.uv.x + 0.06 * row.rem_euclid(2.0);
                let shade = hash_unit((along / 0.12).floor() as i32, row as i32, 4) - 0.5;
                let fade = (1.4 - footprint / 0.11).clamp(0.0, 1.0);
                let lip = joint(s.uv.y, 0.11, 0.03, footprint).max(0.6 * joint(along, 0.12, 0.02, footprint));
                *base * rough(0.7) * (1.0 + 0.5 * shade * fade) * (1.0 - 0.5 * lip)
            }
            Material::Marble { base, vein, size } => {
                let q = p / *size;
                let warp = fbm(q * 1.3, 3, footprint / size);
                let line = (q.x + q.z * 1.4 + q.y * 0.6 + warp * 6.0).sin().abs();
                mix(*vein, *base, (line * 2.2).min(1.0)) * rough(0.7)
            }
            Material::Foliage { base } => {
                let leaves = fbm(p * 5.0, 4, footprint * 5.0);
                let light = Vec3::new(1.0 + leaves * 0.9, 1.0 + leaves * 0.6, 1.0);
                *base * light * (1.0 + 2.0 * leaves)
            }
            Material::Mosaic { a, b, size } => {
                let cell = (s.uv / *size).floor();
                let q = s.uv / *size - cell - Vec2::splat(0.5);
                let (inner, outer) =
                    if (cell.x + cell.y).rem_euclid(2.0) < 1.0 { (*a, *b) } else { (*b, *a) };
                mix(outer, inner, below(q.length(), 0.32, footprint / size)) * rough(0.8)
            }
            Material::Slope { base } => *base * (1.0 + 1.3 * fbm(p * 0.35, 5, footprint * 0.35)),
        };
        (albedo.clamp(Vec3::splat(0.01), Vec3::splat(0.93)), self.bumped(p, s.normal, footprint))
    }

    /// The normal that the light sees: leaves scatter it, everything else keeps the solid's.
    fn bumped(&self, p: Vec3, normal: Vec3, footprint: f32) -> Vec3 {
        let Material::Foliage { .. } = self else { return normal };
        let q = p * 3.5;
        let kept = (1.5 - footprint * 7.0).clamp(0.2, 1.0);
        let push = Vec3::new(noise(q), noise(q + Vec3::splat(31.7)), noise(q + Vec3::splat(67.1))) - 0.5;
        (normal + push * 1.7 * kept).normalize_or(normal)
    }
}

/// Arched windows with a frame on a wall.
fn arch(wall: Vec3, base: Vec3, pane: Vec3, bay: f32, rise: Vec2, uv: Vec2, footprint: f32) -> Vec3 {
    let half = bay * 0.22;
    let x = uv.x - (uv.x / bay).floor() * bay - bay / 2.0;
    let spring = rise.y - half;
    let distance = if uv.y > spring { Vec2::new(x, uv.y - spring).length() } else { x.abs() };
    let outside = distance.max(rise.x + half - uv.y);
    let frame = below(outside, half * 1.3, footprint);
    let glass = below(outside, half * 0.95, footprint);
    let bars = joint(x, half, 0.03, footprint).max(joint(uv.y, half, 0.03, footprint));
    let dim = 1.0 + 0.5 * (noise2(uv * 3.0) - 0.5);
    mix(mix(wall, base * 1.18, frame), mix(pane * dim, base * 0.8, 0.7 * bars), glass)
}

/// Bars and rosettes on upright faces.
fn frieze(base: Vec3, carved: Vec3, period: f32, s: &Surface, footprint: f32) -> Vec3 {
    if s.flat {
        return base;
    }
    let phase = (s.uv.x / period).rem_euclid(1.0);
    let pixel = footprint / period;
    let bar = below((phase - 0.25).abs(), 0.16, pixel);
    let grooves =
        0.55 + 0.45 * (phase * std::f32::consts::TAU * 9.0).cos() * (1.0 - 9.0 * pixel).clamp(0.0, 1.0);
    let rosette = Vec2::new(phase - 0.75, (s.uv.y / period).rem_euclid(1.0) - 0.4).length();
    let ring = below((rosette - 0.13).abs(), 0.045, pixel).max(below(rosette, 0.05, pixel));
    mix(mix(base, carved, 0.55 * ring), base * (0.75 + 0.4 * grooves), bar)
}

fn plaza([flag, band, lawn]: [Vec3; 3], q: Vec2, half: Vec2, footprint: f32) -> Vec3 {
    let p = Vec3::new(q.x, q.y, 0.0);
    let rough = fbm(p * 1.1, 4, footprint * 1.1) * 0.35 + fbm(p * 8.0, 3, footprint * 8.0) * 0.3;
    let cell = (q / 0.62).floor();
    let shade = hash_unit(cell.x as i32, cell.y as i32, 9) - 0.5;
    let fade = (1.4 - footprint / 0.62).clamp(0.0, 1.0);
    let seam = joint(q.x, 0.62, 0.035, footprint).max(joint(q.y, 0.62, 0.035, footprint)) * fade;
    let grid = joint(q.x, 3.1, 0.34, footprint).max(joint(q.y, 3.1, 0.34, footprint));
    let paved = mix(flag, band, 0.8 * grid) * (1.0 + rough + 0.3 * shade * fade) * (1.0 - 0.3 * seam);
    let blades = fbm(p * 0.7, 5, footprint * 0.7) * 0.8 + fbm(p * 6.0, 3, footprint * 6.0) * 0.7;
    let mown = 0.09 * ((q.x * 1.6).sin().signum()) * (1.2 - footprint).clamp(0.0, 1.0);
    let grass = lawn * (1.0 + blades + mown) * Vec3::new(1.0 + 0.5 * blades, 1.0, 1.0);
    let outside = (q.abs() - half).max_element();
    let kerb = below((outside + 0.15).abs(), 0.15, footprint);
    mix(mix(grass, paved, below(outside, 0.0, footprint)), band * (0.9 + rough), kerb)
}
