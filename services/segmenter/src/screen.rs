//! A splat's footprint on a photo, without the low-pass (method, section 7), in f64.

use glam::{DMat3, DQuat, DVec2, DVec3};
use segwild_scene::{Camera, Pose, Splats};

/// A splat's ellipsoid: centre and root of the covariance, as the cut and the coverage need them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Ellipsoid {
    pub mean: DVec3,
    /// `R S`: its columns are the axes times their standard deviations, so `Sigma = root root^T`.
    pub root: DMat3,
}

/// A splat as one photo sees it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct EllipsoidFootprint {
    /// Centre in pixels.
    pub centre: DVec2,
    /// Centre in the camera frame.
    pub camera_mean: DVec3,
    /// Rows of `J W root`: `Sigma_uv = [u.u, u.v; u.v, v.v]`.
    pub u: DVec3,
    pub v: DVec3,
}

/// Principal axes of a footprint.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axes {
    /// Larger eigenvalue, px².
    pub major: f64,
    /// Smaller eigenvalue, px².
    pub minor: f64,
    /// Unit eigenvector of the larger one.
    pub direction: DVec2,
}

impl Ellipsoid {
    /// Splat `i`, or `None` where a parameter or a scale is not a finite number.
    pub fn of(splats: &Splats, i: usize) -> Option<Ellipsoid> {
        let mean = DVec3::from(splats.means[i].map(f64::from));
        let [w, x, y, z] = splats.rotations[i].map(f64::from);
        let q = DQuat::from_xyzw(x, y, z, w);
        let n = q.length_squared();
        let rotation =
            if n > 0.0 && n.is_finite() { DMat3::from_quat(q * (1.0 / n.sqrt())) } else { DMat3::IDENTITY };
        let scale = DVec3::from(splats.log_scales[i].map(|s| f64::from(s).exp()));
        let root = rotation * DMat3::from_diagonal(scale);
        (mean.is_finite() && scale.max_element() < 1e30 && root.is_finite())
            .then_some(Ellipsoid { mean, root })
    }

    /// The footprint, or `None` when the centre is nearer than `near`.
    pub fn project(&self, camera: &Camera, pose: &Pose, near: f32) -> Option<EllipsoidFootprint> {
        let rotation = pose.rotation.as_dmat3();
        let p = rotation * self.mean + pose.translation.as_dvec3();
        if p.z.is_nan() || p.z <= f64::from(near) {
            return None;
        }
        let (fx, fy) = (f64::from(camera.fx), f64::from(camera.fy));
        let root = rotation * self.root;
        let (rx, ry, rz) = (root.row(0), root.row(1), root.row(2));
        let u = fx / p.z * (rx - p.x / p.z * rz);
        let v = fy / p.z * (ry - p.y / p.z * rz);
        let centre = DVec2::new(fx * p.x / p.z + f64::from(camera.cx), fy * p.y / p.z + f64::from(camera.cy));
        (centre.is_finite() && u.is_finite() && v.is_finite()).then_some(EllipsoidFootprint {
            centre,
            camera_mean: p,
            u,
            v,
        })
    }
}

impl EllipsoidFootprint {
    /// Determinant of the covariance with `low_pass` px² on its diagonal.
    pub fn determinant(&self, low_pass: f64) -> f64 {
        // |u x v|² is the determinant without the cancellation of uu vv - uv².
        let plain = self.u.cross(self.v).length_squared();
        plain + low_pass * (self.u.length_squared() + self.v.length_squared() + low_pass)
    }

    /// Eigenvalues and the major direction of the covariance.
    pub fn axes(&self) -> Axes {
        let (a, b, c) = (self.u.length_squared(), self.u.dot(self.v), self.v.length_squared());
        let half = 0.5 * (a - c);
        let root = half.hypot(b);
        let major = 0.5 * (a + c) + root;
        let minor = if major > 0.0 { self.determinant(0.0) / major } else { 0.0 };
        let vector = if half >= 0.0 { DVec2::new(half + root, b) } else { DVec2::new(b, root - half) };
        let direction = vector.try_normalize().unwrap_or(DVec2::X);
        Axes { major, minor, direction }
    }
}
