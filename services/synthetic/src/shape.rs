//! Solids: where a ray meets them, how far a point is from them, and what coordinates their surface has.

use glam::{Mat3, Vec2, Vec3};

/// A solid in the world; x right, y away from the front, z up.
#[derive(Clone, Debug)]
pub enum SolidShape {
    /// A box turned about the vertical.
    Block {
        /// Centre.
        centre: Vec3,
        /// Half of each side.
        half: Vec3,
        /// Cosine and sine of the turn.
        turn: Vec2,
    },
    /// An ellipsoid.
    Ellipsoid {
        /// Centre.
        centre: Vec3,
        /// Semi-axes.
        radii: Vec3,
        /// World to the ellipsoid's axes.
        to_local: Mat3,
    },
    /// A vertical cylinder or cone, the unit of every turned shape.
    Frustum {
        /// Centre of the lower disc.
        base: Vec3,
        /// Height.
        height: f32,
        /// Radius of the lower disc.
        lower: f32,
        /// Radius of the upper disc.
        upper: f32,
        /// `dr/dz` that the normals follow at the lower and upper rim; equal slopes give a plain cone, others
        /// make stacked slices appear round.
        slopes: [f32; 2],
    },
    /// A thick segment.
    Capsule {
        /// One end.
        a: Vec3,
        /// The other end.
        b: Vec3,
        /// Radius.
        radius: f32,
    },
    /// The points on the inner side of every plane `n . p <= d`; normals have length 1.
    Convex {
        /// The planes.
        planes: Vec<(Vec3, f32)>,
        /// A corner of its bounding box and the opposite one.
        bounds: (Vec3, Vec3),
    },
}

/// The surface at a hit.
#[derive(Clone, Copy, Debug)]
pub struct Surface {
    /// Outward normal.
    pub normal: Vec3,
    /// Coordinates on the surface, in world units: along, and up.
    pub uv: Vec2,
    /// Whether the surface is a horizontal top or bottom, or has no natural `uv`.
    pub flat: bool,
}

impl SolidShape {
    /// A box that stands with its lower centre at `foot`, with sides `size`, turned by `yaw` radians.
    pub fn block(foot: Vec3, size: Vec3, yaw: f32) -> SolidShape {
        let centre = foot + Vec3::new(0.0, 0.0, size.z / 2.0);
        SolidShape::Block { centre, half: size / 2.0, turn: Vec2::new(yaw.cos(), yaw.sin()) }
    }

    /// A cylinder or cone.
    pub fn frustum(base: Vec3, height: f32, lower: f32, upper: f32) -> SolidShape {
        let slope = (upper - lower) / height;
        SolidShape::Frustum { base, height, lower, upper, slopes: [slope, slope] }
    }

    /// A ball.
    pub fn ball(centre: Vec3, radius: f32) -> SolidShape {
        SolidShape::Ellipsoid { centre, radii: Vec3::splat(radius), to_local: Mat3::IDENTITY }
    }

    /// The frustums of a shape turned about the vertical: `profile` has (height, radius) rising from `base`.
    pub fn turned(base: Vec3, profile: &[(f32, f32)]) -> Vec<SolidShape> {
        let slope = |i: usize| {
            let (lo, hi) = (profile[i.saturating_sub(1)], profile[(i + 1).min(profile.len() - 1)]);
            (hi.1 - lo.1) / (hi.0 - lo.0)
        };
        let slice = |i: usize| {
            let ((z0, lower), (z1, upper)) = (profile[i], profile[i + 1]);
            let base = base + Vec3::new(0.0, 0.0, z0);
            SolidShape::Frustum { base, height: z1 - z0, lower, upper, slopes: [slope(i), slope(i + 1)] }
        };
        (0..profile.len() - 1).map(slice).collect()
    }

    /// A roof over a rectangle: the ridge runs along x for `ridge` (0 is a pyramid, the whole width a gable).
    pub fn roof(foot: Vec3, width: f32, depth: f32, height: f32, ridge: f32) -> SolidShape {
        let (hw, hd) = (width / 2.0, depth / 2.0);
        let mut planes = vec![(Vec3::NEG_Z, -foot.z)];
        let mut side = |normal: Vec3, point: Vec3| {
            let n = normal.normalize();
            planes.push((n, n.dot(foot + point)));
        };
        for s in [-1.0, 1.0] {
            side(Vec3::new(0.0, s * height, hd), Vec3::new(0.0, s * hd, 0.0));
            side(Vec3::new(s * height, 0.0, hw - ridge / 2.0), Vec3::new(s * hw, 0.0, 0.0));
        }
        let half = Vec3::new(hw, hd, 0.0);
        SolidShape::Convex { planes, bounds: (foot - half, foot + half + Vec3::new(0.0, 0.0, height)) }
    }

    /// Two opposite corners of a box around the solid.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        match self {
            SolidShape::Block { centre, half, turn } => {
                let (c, s) = (turn.x.abs(), turn.y.abs());
                let reach = Vec3::new(c * half.x + s * half.y, s * half.x + c * half.y, half.z);
                (*centre - reach, *centre + reach)
            }
            SolidShape::Ellipsoid { centre, radii, to_local } => {
                let axes = to_local.transpose() * Mat3::from_diagonal(*radii);
                let rows = axes.transpose();
                let reach = Vec3::new(rows.x_axis.length(), rows.y_axis.length(), rows.z_axis.length());
                (*centre - reach, *centre + reach)
            }
            SolidShape::Frustum { base, height, lower, upper, .. } => {
                let r = lower.max(*upper);
                (*base - Vec3::new(r, r, 0.0), *base + Vec3::new(r, r, *height))
            }
            SolidShape::Capsule { a, b, radius } => (a.min(*b) - *radius, a.max(*b) + *radius),
            SolidShape::Convex { bounds, .. } => *bounds,
        }
    }

    /// Distance along the unit direction `d` from `o` to the first crossing after `least`, if any.
    pub fn hit(&self, o: Vec3, d: Vec3, least: f32) -> Option<f32> {
        match self {
            SolidShape::Block { centre, half, turn } => {
                let (o, d) = (unturn(o - *centre, *turn), unturn(d, *turn));
                let inverse = d.recip();
                let (a, b) = ((-*half - o) * inverse, (*half - o) * inverse);
                let (enter, leave) = (a.min(b).max_element(), a.max(b).min_element());
                first(enter, leave, least)
            }
            SolidShape::Ellipsoid { centre, radii, to_local } => {
                let start = (*centre - o).dot(d);
                let o = (*to_local * (o + d * start - *centre)) / *radii;
                let d = (*to_local * d) / *radii;
                let (a, b, c) = (d.length_squared(), o.dot(d), o.length_squared() - 1.0);
                let root = b * b - a * c;
                if root < 0.0 {
                    return None;
                }
                let root = root.sqrt();
                first(start + (-b - root) / a, start + (-b + root) / a, least)
            }
            SolidShape::Frustum { base, height, lower, upper, .. } => {
                // Starting near the solid keeps the quadratic's terms small.
                let start = (*base + Vec3::new(0.0, 0.0, height / 2.0) - o).dot(d);
                hit_frustum(o + d * start - *base, d, *height, *lower, *upper, least - start)
                    .map(|t| t + start)
            }
            SolidShape::Capsule { a, b, radius } => {
                let start = ((*a + *b) / 2.0 - o).dot(d);
                hit_capsule(o + d * start - *a, d, *b - *a, *radius, least - start).map(|t| t + start)
            }
            SolidShape::Convex { planes, .. } => {
                let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
                for &(n, k) in planes {
                    let (speed, gap) = (n.dot(d), k - n.dot(o));
                    if speed.abs() < 1e-9 {
                        if gap < 0.0 {
                            return None;
                        }
                    } else if speed < 0.0 {
                        enter = enter.max(gap / speed);
                    } else {
                        leave = leave.min(gap / speed);
                    }
                }
                first(enter, leave, least)
            }
        }
    }

    /// Signed distance of a point: exact but for ellipsoids, where it is to first order.
    pub fn distance(&self, p: Vec3) -> f32 {
        match self {
            SolidShape::Block { centre, half, turn } => {
                let q = unturn(p - *centre, *turn).abs() - *half;
                q.max(Vec3::ZERO).length() + q.max_element().min(0.0)
            }
            SolidShape::Ellipsoid { centre, radii, to_local } => {
                let q = *to_local * (p - *centre);
                let (k0, k1) = ((q / *radii).length(), (q / (*radii * *radii)).length());
                if k1 < 1e-9 { -radii.min_element() } else { k0 * (k0 - 1.0) / k1 }
            }
            SolidShape::Frustum { base, height, lower, upper, .. } => {
                let q = p - *base;
                let q = Vec2::new(q.truncate().length(), q.z);
                let rim = |r: f32, z: f32| Vec2::new(r, z);
                let outline = [rim(0.0, 0.0), rim(*lower, 0.0), rim(*upper, *height), rim(0.0, *height)];
                let distance =
                    outline.windows(2).map(|w| segment(q, w[0], w[1])).fold(f32::INFINITY, f32::min);
                let inside = q.y >= 0.0 && q.y <= *height && q.x <= lower + (upper - lower) * q.y / height;
                if inside { -distance } else { distance }
            }
            SolidShape::Capsule { a, b, radius } => {
                let (pa, ba) = (p - *a, *b - *a);
                let h = (pa.dot(ba) / ba.length_squared()).clamp(0.0, 1.0);
                (pa - ba * h).length() - radius
            }
            SolidShape::Convex { planes, .. } => {
                let deepest = planes.iter().map(|&(n, k)| n.dot(p) - k).fold(f32::NEG_INFINITY, f32::max);
                if deepest <= 0.0 { deepest } else { (p - nearest_in(planes, p)).length() }
            }
        }
    }

    /// The surface at a point of it.
    pub fn surface(&self, p: Vec3) -> Surface {
        match self {
            SolidShape::Block { centre, half, turn } => {
                let q = unturn(p - *centre, *turn);
                let near = (q.abs() - *half).to_array();
                let axis = if near[0] >= near[1] && near[0] >= near[2] {
                    0
                } else {
                    2 - (near[1] >= near[2]) as usize
                };
                let sign = q[axis].signum();
                let foot = q.z + half.z;
                let (local, uv) = match axis {
                    0 => (Vec3::X, Vec2::new(q.y + half.y, foot)),
                    1 => (Vec3::Y, Vec2::new(q.x + half.x, foot)),
                    _ => (Vec3::Z, q.truncate()),
                };
                let n = local * sign;
                let normal = Vec3::new(turn.x * n.x - turn.y * n.y, turn.y * n.x + turn.x * n.y, n.z);
                Surface { normal, uv, flat: axis == 2 }
            }
            SolidShape::Ellipsoid { centre, radii, to_local } => {
                let q = *to_local * (p - *centre);
                let normal = (to_local.transpose() * (q / (*radii * *radii))).normalize_or(Vec3::Z);
                Surface { normal, uv: Vec2::new(q.y.atan2(q.x) * radii.x, q.z), flat: true }
            }
            SolidShape::Frustum { base, height, lower, upper, slopes } => {
                let q = p - *base;
                let r = q.truncate().length();
                let on_side = (lower + (upper - lower) * (q.z / height) - r).abs();
                let (to_lower, to_upper) = (q.z.abs(), (height - q.z).abs());
                if on_side > to_lower.min(to_upper) + 1e-4 {
                    let normal = if to_upper < to_lower { Vec3::Z } else { Vec3::NEG_Z };
                    return Surface { normal, uv: q.truncate(), flat: true };
                }
                let slope = slopes[0] + (slopes[1] - slopes[0]) * (q.z / height).clamp(0.0, 1.0);
                let outward = q.truncate() / r.max(1e-6);
                let normal = Vec3::new(outward.x, outward.y, -slope).normalize();
                Surface { normal, uv: Vec2::new(q.y.atan2(q.x), q.z), flat: false }
            }
            SolidShape::Capsule { a, b, radius } => {
                let (pa, ba) = (p - *a, *b - *a);
                let h = (pa.dot(ba) / ba.length_squared()).clamp(0.0, 1.0);
                let normal = (pa - ba * h).normalize_or(Vec3::Z);
                Surface { normal, uv: Vec2::new(h * ba.length() / radius, normal.x), flat: true }
            }
            SolidShape::Convex { planes, .. } => {
                let over = |plane: &(Vec3, f32)| plane.0.dot(p) - plane.1;
                let face = planes.iter().max_by(|a, b| over(a).total_cmp(&over(b)));
                let n = face.map_or(Vec3::Z, |f| f.0);
                let along = Vec3::new(-n.y, n.x, 0.0).normalize_or(Vec3::X);
                let up = n.cross(along);
                Surface { normal: n, uv: Vec2::new(p.dot(along), p.dot(up)), flat: n.z < -0.5 }
            }
        }
    }
}

/// The point of a convex solid nearest to a point outside it (Dykstra's projections).
fn nearest_in(planes: &[(Vec3, f32)], p: Vec3) -> Vec3 {
    const ROUNDS: usize = 24;
    let mut x = p;
    // What each plane moved the point by last time; a roof has five planes.
    let mut moved = [Vec3::ZERO; 8];
    for _ in 0..ROUNDS {
        for (&(n, k), last) in planes.iter().zip(&mut moved) {
            let back = x - *last;
            let step = n * -(n.dot(back) - k).max(0.0);
            x = back + step;
            *last = step;
        }
    }
    x
}

/// The first of two crossings that lies after `least`.
fn first(enter: f32, leave: f32, least: f32) -> Option<f32> {
    if enter > leave {
        return None;
    }
    if enter > least {
        return Some(enter);
    }
    (leave > least && leave.is_finite()).then_some(leave)
}

/// A world vector in the axes of a box turned by (cos, sin).
fn unturn(v: Vec3, turn: Vec2) -> Vec3 {
    Vec3::new(turn.x * v.x + turn.y * v.y, turn.x * v.y - turn.y * v.x, v.z)
}

fn hit_frustum(o: Vec3, d: Vec3, height: f32, lower: f32, upper: f32, least: f32) -> Option<f32> {
    let mut best = f32::INFINITY;
    let mut offer = |t: f32| {
        if t > least && t < best {
            best = t;
        }
    };
    let k = (upper - lower) / height;
    let r = lower + k * o.z;
    let a = d.x * d.x + d.y * d.y - k * k * d.z * d.z;
    let b = o.x * d.x + o.y * d.y - k * r * d.z;
    let c = o.x * o.x + o.y * o.y - r * r;
    let root = b * b - a * c;
    if root >= 0.0 && a.abs() > 1e-9 {
        let root = root.sqrt();
        for t in [(-b - root) / a, (-b + root) / a] {
            let z = o.z + t * d.z;
            if z >= 0.0 && z <= height && lower + k * z >= 0.0 {
                offer(t);
            }
        }
    }
    if d.z.abs() > 1e-9 {
        for (z, rim) in [(0.0, lower), (height, upper)] {
            let t = (z - o.z) / d.z;
            let (x, y) = (o.x + t * d.x, o.y + t * d.y);
            if x * x + y * y <= rim * rim {
                offer(t);
            }
        }
    }
    best.is_finite().then_some(best)
}

/// `o` is relative to the capsule's first end, `axis` leads to the other.
fn hit_capsule(o: Vec3, d: Vec3, axis: Vec3, radius: f32, least: f32) -> Option<f32> {
    let mut best = f32::INFINITY;
    let mut offer = |t: f32| {
        if t > least && t < best {
            best = t;
        }
    };
    let (length2, along, from) = (axis.length_squared(), axis.dot(d), axis.dot(o));
    let a = length2 - along * along;
    let b = length2 * o.dot(d) - from * along;
    let c = length2 * (o.length_squared() - radius * radius) - from * from;
    let root = b * b - a * c;
    if root >= 0.0 && a > 1e-9 {
        let root = root.sqrt();
        for t in [(-b - root) / a, (-b + root) / a] {
            let y = from + t * along;
            if y >= 0.0 && y <= length2 {
                offer(t);
            }
        }
    }
    for (end, beyond) in [(Vec3::ZERO, -1.0), (axis, 1.0)] {
        let q = o - end;
        let (b, c) = (q.dot(d), q.length_squared() - radius * radius);
        let root = b * b - c;
        if root >= 0.0 {
            let root = root.sqrt();
            for t in [-b - root, -b + root] {
                // Only the half of the ball that faces away from the segment is surface.
                if (q + d * t).dot(axis) * beyond >= 0.0 {
                    offer(t);
                }
            }
        }
    }
    best.is_finite().then_some(best)
}

fn segment(p: Vec2, a: Vec2, b: Vec2) -> f32 {
    let (pa, ba) = (p - a, b - a);
    let h = if ba.length_squared() > 0.0 { (pa.dot(ba) / ba.length_squared()).clamp(0.0, 1.0) } else { 0.0 };
    (pa - ba * h).length()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::random::Rng;

    /// Solids of every kind.
    pub(crate) fn some_shapes(rng: &mut Rng) -> Vec<SolidShape> {
        (0..60)
            .map(|i| {
                let at = rng.triple(-3.0, 3.0);
                let size = rng.triple(0.2, 1.2);
                match i % 5 {
                    0 => SolidShape::block(at, size, rng.range(-2.0, 2.0)),
                    1 => {
                        let to_local = Mat3::from_rotation_x(rng.range(-2.0, 2.0));
                        SolidShape::Ellipsoid { centre: at, radii: size, to_local }
                    }
                    2 => SolidShape::frustum(at, size.z, size.x, size.y * 0.5),
                    3 => SolidShape::Capsule { a: at, b: at + rng.triple(-1.0, 1.0), radius: size.x * 0.4 },
                    _ => SolidShape::roof(at, size.x, size.y, size.z, size.x * 0.3),
                }
            })
            .collect()
    }

    #[test]
    fn a_ray_ends_on_the_surface_and_the_normal_faces_it() {
        let mut rng = Rng::new(5, 0);
        let (mut hits, mut outward) = (0, 0);
        for shape in some_shapes(&mut rng) {
            for _ in 0..40 {
                let o = rng.triple(-30.0, 30.0);
                let (low, high) = shape.bounds();
                let aim = low + (high - low) * rng.triple(0.0, 1.0);
                let d = (aim - o).normalize();
                let Some(t) = shape.hit(o, d, 1e-4).filter(|_| shape.distance(o) > 0.05) else { continue };
                let p = o + d * t;
                hits += 1;
                assert!(shape.distance(p).abs() < 2e-3, "{shape:?}: {}", shape.distance(p));
                assert!(p.cmpge(low - 1e-3).all() && p.cmple(high + 1e-3).all());
                let n = shape.surface(p).normal;
                assert!((n.length() - 1.0).abs() < 1e-3);
                // The first crossing from outside enters: only a rim can confuse which face it is on.
                outward += usize::from(n.dot(d) < 0.02);
            }
        }
        assert!(hits > 800, "{hits}");
        assert!(outward as f64 > 0.99 * hits as f64, "{outward} of {hits}");
    }
}
