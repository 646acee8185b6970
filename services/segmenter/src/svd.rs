//! The axes of a 3x3 covariance from its root.

use glam::{DMat3, DVec3};

/// Sweeps at most; three by three matrices converge in four or five.
const SWEEPS: usize = 30;

/// Eigenvectors (as columns of a proper rotation) and square roots of the eigenvalues of `root root^T`.
///
/// One-sided Jacobi: the columns of `root` are rotated among each other until they are orthogonal, which is the
/// symmetric Jacobi eigen-decomposition of `root^T root` without ever forming it: a splat that is a million
/// times thinner in one direction than in another keeps its thickness. Finite for every finite input.
pub(crate) fn left(root: DMat3) -> (DMat3, [f64; 3]) {
    let mut columns = [root.x_axis, root.y_axis, root.z_axis];
    let largest = columns.iter().map(|c| c.abs().max_element()).fold(0.0, f64::max);
    if largest == 0.0 || !largest.is_finite() {
        return (DMat3::IDENTITY, [0.0; 3]);
    }
    for c in &mut columns {
        *c /= largest;
    }
    for _ in 0..SWEEPS {
        let mut rotated = false;
        for (i, j) in [(0, 1), (0, 2), (1, 2)] {
            let (a, b) = (columns[i], columns[j]);
            let (alpha, beta, gamma) = (a.length_squared(), b.length_squared(), a.dot(b));
            if gamma == 0.0 || gamma.abs() <= 1e-15 * (alpha * beta).sqrt() {
                continue;
            }
            rotated = true;
            let zeta = (beta - alpha) / (2.0 * gamma);
            let t =
                if zeta.abs() > 1e150 { 0.5 / zeta } else { zeta.signum() / (zeta.abs() + zeta.hypot(1.0)) };
            let c = 1.0 / t.hypot(1.0);
            let s = c * t;
            columns[i] = a * c - b * s;
            columns[j] = a * s + b * c;
        }
        if !rotated {
            break;
        }
    }
    let deviations = columns.map(|c| c.length());
    // Longest first for the basis: a vanishing column gets its direction from the others.
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| deviations[b].total_cmp(&deviations[a]));
    let first = columns[order[0]].normalize();
    let second = columns[order[1]] - first * first.dot(columns[order[1]]);
    let second = if second.length() > 1e-150 { second.normalize() } else { first.any_orthonormal_vector() };
    let second = (second - first * first.dot(second)).normalize();
    let mut axes = [DVec3::ZERO; 3];
    axes[order[0]] = first;
    axes[order[1]] = second;
    axes[order[2]] = first.cross(second);
    let mut axes = DMat3::from_cols(axes[0], axes[1], axes[2]);
    if axes.determinant() < 0.0 {
        *axes.col_mut(order[2]) *= -1.0;
    }
    (axes, deviations.map(|d| d * largest))
}
