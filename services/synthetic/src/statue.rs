//! Figures of rounded limbs.

use crate::shape::SolidShape;
use glam::{Mat3, Vec3};

/// What a standing figure does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StatuePose {
    /// Holds a torch up.
    TorchBearer,
    /// Has wings and a staff.
    Winged,
}

/// Positions limbs given in a figure's own measure: x to its right as seen from the front, y away, height 1.
struct Sculptor {
    foot: Vec3,
    height: f32,
    side: f32,
    limbs: Vec<SolidShape>,
}

impl Sculptor {
    fn at(&self, p: [f32; 3]) -> Vec3 {
        self.foot + Vec3::new(p[0] * self.side, p[1], p[2]) * self.height
    }

    fn limb(&mut self, from: [f32; 3], to: [f32; 3], radius: f32) {
        let limb = SolidShape::Capsule { a: self.at(from), b: self.at(to), radius: radius * self.height };
        self.limbs.push(limb);
    }

    /// An ellipsoid turned by `roll` about the view axis.
    fn mass(&mut self, centre: [f32; 3], radii: [f32; 3], roll: f32) {
        let shape = SolidShape::Ellipsoid {
            centre: self.at(centre),
            radii: Vec3::from(radii) * self.height,
            to_local: Mat3::from_rotation_y(-roll * self.side).transpose(),
        };
        self.limbs.push(shape);
    }

    fn turned(&mut self, foot: [f32; 3], profile: &[(f32, f32)]) {
        let scaled: Vec<(f32, f32)> =
            profile.iter().map(|&(z, r)| (z * self.height, r * self.height)).collect();
        self.limbs.extend(SolidShape::turned(self.at(foot), &scaled));
    }
}

/// A draped figure `height` tall at `foot`; `side` -1 or 1 mirrors it.
pub fn figure(foot: Vec3, height: f32, side: f32, pose: StatuePose) -> Vec<SolidShape> {
    let mut s = Sculptor { foot, height, side, limbs: Vec::new() };
    s.turned([0.0; 3], &[(0.0, 0.17), (0.06, 0.165), (0.25, 0.13), (0.45, 0.105), (0.56, 0.085)]);
    s.limb([-0.05, -0.12, 0.03], [-0.04, -0.05, 0.40], 0.055);
    s.mass([0.0, 0.0, 0.66], [0.125, 0.09, 0.165], 0.0);
    s.limb([-0.10, 0.0, 0.765], [0.10, 0.0, 0.765], 0.052);
    s.limb([0.0, 0.0, 0.80], [0.0, 0.0, 0.86], 0.035);
    s.mass([0.0, -0.01, 0.915], [0.062, 0.07, 0.082], 0.0);
    // A fold of the cloak from the shoulder to the hip.
    s.limb([0.10, -0.06, 0.76], [-0.10, -0.08, 0.47], 0.04);
    match pose {
        StatuePose::TorchBearer => {
            s.limb([0.13, 0.0, 0.76], [0.23, -0.06, 0.88], 0.04);
            s.limb([0.23, -0.06, 0.88], [0.21, -0.10, 1.08], 0.034);
            s.turned([0.21, -0.10, 1.04], &[(0.0, 0.018), (0.12, 0.03), (0.14, 0.055), (0.18, 0.05)]);
            s.mass([0.21, -0.10, 1.28], [0.045, 0.045, 0.075], 0.0);
            s.limb([-0.13, 0.0, 0.76], [-0.19, -0.03, 0.58], 0.04);
            s.limb([-0.19, -0.03, 0.58], [-0.10, -0.14, 0.55], 0.033);
        }
        StatuePose::Winged => {
            s.mass([0.22, 0.09, 0.80], [0.085, 0.03, 0.27], 0.55);
            s.mass([-0.22, 0.09, 0.80], [0.085, 0.03, 0.27], -0.55);
            s.limb([-0.13, 0.0, 0.76], [-0.22, -0.10, 0.62], 0.038);
            s.limb([-0.24, -0.14, 0.0], [-0.24, -0.14, 1.12], 0.017);
            s.mass([-0.24, -0.14, 1.14], [0.04, 0.02, 0.06], 0.0);
            s.limb([0.13, 0.0, 0.76], [0.18, -0.05, 0.55], 0.038);
        }
    }
    s.limbs
}

/// A horse with its rider, `height` tall together, heading along x.
pub fn rider(foot: Vec3, height: f32, way: f32) -> Vec<SolidShape> {
    let mut s = Sculptor { foot, height, side: way, limbs: Vec::new() };
    s.mass([0.0, 0.0, 0.46], [0.30, 0.125, 0.135], 0.0);
    s.mass([0.20, 0.0, 0.49], [0.13, 0.11, 0.14], 0.0);
    s.mass([-0.22, 0.0, 0.48], [0.13, 0.12, 0.14], 0.0);
    s.limb([0.27, 0.0, 0.53], [0.40, 0.0, 0.72], 0.075);
    s.limb([0.40, 0.0, 0.74], [0.52, 0.0, 0.64], 0.048);
    s.limb([0.38, -0.03, 0.78], [0.37, -0.03, 0.83], 0.018);
    // Three legs stand, the fourth is raised.
    for (x, y) in [(-0.26, -0.07), (-0.20, 0.07), (0.20, 0.07)] {
        s.limb([x, y, 0.38], [x - 0.03, y, 0.20], 0.042);
        s.limb([x - 0.03, y, 0.20], [x, y, 0.0], 0.030);
    }
    s.limb([0.24, -0.07, 0.38], [0.37, -0.07, 0.30], 0.042);
    s.limb([0.37, -0.07, 0.30], [0.34, -0.07, 0.14], 0.030);
    s.limb([-0.33, 0.0, 0.52], [-0.42, 0.0, 0.26], 0.032);
    s.mass([-0.01, 0.0, 0.72], [0.075, 0.085, 0.15], 0.0);
    s.mass([0.0, 0.0, 0.925], [0.045, 0.045, 0.058], 0.0);
    s.limb([0.0, -0.09, 0.62], [0.06, -0.15, 0.38], 0.035);
    s.limb([0.0, 0.09, 0.62], [0.06, 0.15, 0.38], 0.035);
    s.limb([0.02, -0.09, 0.81], [0.18, -0.10, 0.74], 0.028);
    s.limb([0.02, 0.09, 0.81], [0.14, 0.10, 0.95], 0.028);
    s.limb([-0.05, 0.02, 0.80], [-0.20, 0.03, 0.62], 0.05);
    s.limbs
}
