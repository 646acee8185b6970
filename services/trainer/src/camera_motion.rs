//! Small motions of a camera, and the least squares that find them (method, section 3).

use glam::{DMat3, DQuat, DVec3, Vec2};
use segwild_nn::solve;
use segwild_scene::{Camera, Pose};

/// A motion of the camera in its own frame: translation, then rotation vector.
pub(crate) type Twist = [f64; 6];

/// Standard deviations at which Tukey's biweight takes a residual for an outlier (95 % efficiency on normal noise).
pub(crate) const TUKEY: f64 = 4.685;
/// Damping of the normal equations, as a share of their diagonal (Levenberg and Marquardt).
const DAMPING: f64 = 1e-3;

/// The pose after a motion.
pub(crate) fn moved(pose: &Pose, twist: &Twist) -> Pose {
    let turn = DQuat::from_scaled_axis(DVec3::new(twist[3], twist[4], twist[5]));
    let rotation = turn * DQuat::from_mat3(&pose.rotation.as_dmat3());
    let translation = turn * pose.translation.as_dvec3() + DVec3::new(twist[0], twist[1], twist[2]);
    Pose { rotation: DMat3::from_quat(rotation.normalize()).as_mat3(), translation: translation.as_vec3() }
}

/// How far what a pixel shows moves across and down the photo, in pixels, per number of the twist.
pub(crate) fn flow(camera: &Camera, pixel: Vec2, depth: f64) -> [Twist; 2] {
    let ray = camera.ray(pixel);
    let (u, v, near) = (f64::from(ray.x), f64::from(ray.y), 1.0 / depth);
    let (fx, fy) = (f64::from(camera.fx), f64::from(camera.fy));
    [
        [near, 0.0, -u * near, -u * v, 1.0 + u * u, -v].map(|d| d * fx),
        [0.0, near, -v * near, -(1.0 + v * v), u * v, u].map(|d| d * fy),
    ]
}

/// Weighted least squares for a twist.
#[derive(Clone, Debug, Default)]
pub(crate) struct NormalEquations {
    matrix: [Twist; 6],
    right: [[f64; 1]; 6],
}

impl NormalEquations {
    /// Adds an equation: the twist is to change a residual, by so much per number of it, to 0.
    pub fn add(&mut self, weight: f64, jacobian: &Twist, residual: f64) {
        for a in 0..6 {
            self.right[a][0] -= weight * jacobian[a] * residual;
            for b in 0..6 {
                self.matrix[a][b] += weight * jacobian[a] * jacobian[b];
            }
        }
    }

    /// The twist; `None` where the equations leave a part of it open.
    pub fn twist(&self) -> Option<Twist> {
        self.solved(self.right).map(|twist| twist.map(|[v]| v))
    }

    /// The covariance of the twist, if residuals have a variance of 1; `None` as for [`NormalEquations::twist`].
    pub fn covariance(&self) -> Option<[Twist; 6]> {
        self.solved(std::array::from_fn(|a| std::array::from_fn(|b| f64::from(u8::from(a == b)))))
    }

    fn solved<const M: usize>(&self, right: [[f64; M]; 6]) -> Option<[[f64; M]; 6]> {
        let mut matrix = self.matrix;
        for (k, row) in matrix.iter_mut().enumerate() {
            if row[k] <= 0.0 {
                return None;
            }
            row[k] *= 1.0 + DAMPING;
        }
        let solution = solve(matrix, right);
        solution.as_flattened().iter().all(|v| v.is_finite()).then_some(solution)
    }
}

/// `a^T M b`.
pub(crate) fn form(a: &Twist, matrix: &[Twist; 6], b: &Twist) -> f64 {
    (0..6).map(|i| (0..6).map(|j| a[i] * matrix[i][j] * b[j]).sum::<f64>()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn the_flow_is_the_derivative_of_where_a_point_lies() {
        let camera = Camera { width: 64, height: 48, fx: 50.0, fy: 60.0, cx: 30.0, cy: 25.0 };
        let pose = Pose::look_at(Vec3::new(0.3, -0.2, -1.0), Vec3::ZERO, Vec3::NEG_Y);
        let point = Vec3::new(0.2, 0.1, 0.4);
        let at = pose.to_camera(point);
        let flow = flow(&camera, camera.pixel(at), f64::from(at.z));
        for k in 0..6 {
            let lies = |step: f64| {
                let twist: Twist = std::array::from_fn(|i| if i == k { step } else { 0.0 });
                camera.pixel(moved(&pose, &twist).to_camera(point)).as_dvec2()
            };
            let slope = (lies(1e-3) - lies(-1e-3)) / 2e-3;
            let off = (slope.x - flow[0][k]).abs().max((slope.y - flow[1][k]).abs());
            assert!(off < 0.05, "{k}: {slope} and {} {}", flow[0][k], flow[1][k]);
        }
    }
}
