//! Registration of splats to the points of a reconstruction: iterated closest points, with a similarity in closed form (Horn
//! 1987). The points that fit worst are left out, for not every point has a splat.

use glam::{DMat3, DQuat, DVec3};
use segwild_nn::eigen;
use segwild_scene::Similarity;
use segwild_scene::knn::NearestPoint;

/// Share of the points that count in each step: those that fit best.
const COUNTED: f64 = 0.7;
/// Most steps, and the change of the residual, as a share of it, at which they end.
const STEPS: usize = 40;
const SETTLED: f64 = 1e-4;

/// The centres of splats, with the points that they are registered to.
pub(super) struct Registration<'a> {
    /// Centres of splats, in their own world.
    pub centres: &'a [[f32; 3]],
    pub tree: NearestPoint,
    /// Points of the reconstruction, in its own units.
    pub points: Vec<DVec3>,
}

impl Registration<'_> {
    /// Of each point, its nearest splat and the distance in units of the reconstruction, if `to` leads from the world of the
    /// splats to that of the points. Nearest first.
    fn pairs(&self, to: &Similarity) -> Vec<(f64, DVec3, DVec3)> {
        let back = to.inverse();
        let pair = |point: &DVec3| {
            let (splat, distance) = self.tree.to(back.apply(*point).to_array().map(|v| v as f32))?;
            let centre = DVec3::from(self.centres[splat].map(f64::from));
            Some((f64::from(distance) * to.scale, centre, *point))
        };
        let mut pairs: Vec<_> = self.points.iter().filter_map(pair).collect();
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        pairs
    }

    /// Median distance of the points to their nearest splat, in units of the reconstruction; infinite where there is none.
    pub fn residual(&self, to: &Similarity) -> f64 {
        let pairs = self.pairs(to);
        if pairs.len() * 2 < self.points.len() {
            return f64::INFINITY;
        }
        pairs.get(pairs.len() / 2).map_or(f64::INFINITY, |pair| pair.0)
    }

    /// A similarity near `start` by which the splats lie nearer to the points.
    pub fn refined(&self, start: &Similarity) -> Similarity {
        let mut best = *start;
        let mut before = f64::INFINITY;
        for _ in 0..STEPS {
            let mut pairs = self.pairs(&best);
            pairs.truncate((pairs.len() as f64 * COUNTED) as usize);
            let residual = pairs.iter().map(|pair| pair.0).sum::<f64>() / pairs.len().max(1) as f64;
            if residual.is_nan() || residual >= before * (1.0 - SETTLED) {
                break;
            }
            before = residual;
            let matched: Vec<(DVec3, DVec3)> = pairs.into_iter().map(|(_, from, to)| (from, to)).collect();
            match similarity(&matched) {
                Some(next) => best = next,
                None => break,
            }
        }
        best
    }
}

/// The similarity that leads from the first points of pairs to the second ones, by least squares; `None` where the points do
/// not determine it.
pub(super) fn similarity(pairs: &[(DVec3, DVec3)]) -> Option<Similarity> {
    let n = pairs.len() as f64;
    if pairs.len() < 4 {
        return None;
    }
    let from = pairs.iter().map(|pair| pair.0).sum::<DVec3>() / n;
    let to = pairs.iter().map(|pair| pair.1).sum::<DVec3>() / n;
    let mut m = DMat3::ZERO;
    let (mut spread, mut reached) = (0.0, 0.0);
    for (a, b) in pairs.iter().map(|(a, b)| (*a - from, *b - to)) {
        m += DMat3::from_cols(a * b.x, a * b.y, a * b.z);
        spread += a.length_squared();
        reached += b.length_squared();
    }
    // Column k of `m` holds the sums of a times b's k-th coordinate.
    let s = |i: usize, k: usize| m.col(k)[i];
    let matrix = vec![
        s(0, 0) + s(1, 1) + s(2, 2),
        s(1, 2) - s(2, 1),
        s(2, 0) - s(0, 2),
        s(0, 1) - s(1, 0),
        s(1, 2) - s(2, 1),
        s(0, 0) - s(1, 1) - s(2, 2),
        s(0, 1) + s(1, 0),
        s(2, 0) + s(0, 2),
        s(2, 0) - s(0, 2),
        s(0, 1) + s(1, 0),
        s(1, 1) - s(0, 0) - s(2, 2),
        s(1, 2) + s(2, 1),
        s(0, 1) - s(1, 0),
        s(2, 0) + s(0, 2),
        s(1, 2) + s(2, 1),
        s(2, 2) - s(0, 0) - s(1, 1),
    ];
    let (_, vectors) = eigen::symmetric(matrix, 4);
    let [w, x, y, z] = [0, 1, 2, 3].map(|k| vectors[k]);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scale = (reached / spread).sqrt();
    let found = Similarity { rotation, scale, translation: to - rotation * from * scale };
    (scale.is_finite() && scale > 0.0 && found.translation.is_finite() && rotation.is_finite())
        .then_some(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Random;

    fn cloud(random: &mut Random, n: usize) -> Vec<[f32; 3]> {
        (0..n).map(|_| [random.normal(), 0.6 * random.normal() + 1.0, 0.3 * random.normal()]).collect()
    }

    fn some() -> Similarity {
        let rotation = DMat3::from_axis_angle(DVec3::new(0.36, -0.48, 0.8), 0.7);
        Similarity { rotation, scale: 3.5, translation: DVec3::new(10.0, -2.0, 4.0) }
    }

    fn off(a: &Similarity, b: &Similarity) -> f64 {
        let corners = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        corners.iter().map(|p| (a.apply(*p) - b.apply(*p)).length()).fold(0.0, f64::max)
    }

    #[test]
    fn pairs_give_their_similarity() {
        let mut random = Random::new(3);
        let to = some();
        let pair = |p: &[f32; 3]| {
            let from = DVec3::from(p.map(f64::from));
            (from, to.apply(from))
        };
        let pairs: Vec<_> = cloud(&mut random, 20).iter().map(pair).collect();
        assert!(off(&similarity(&pairs).expect("it is determined"), &to) < 1e-9);
        assert_eq!(similarity(&pairs[..3]), None);
        assert_eq!(similarity(&[pairs[0]; 8]), None, "one point has no size");
    }

    #[test]
    fn points_without_splats_do_not_pull_the_others() {
        let mut random = Random::new(5);
        let centres = cloud(&mut random, 3000);
        let to = some();
        let seen = |p: &[f32; 3]| to.apply(DVec3::from(p.map(f64::from)));
        let mut points: Vec<DVec3> = centres.iter().step_by(4).map(seen).collect();
        points.extend(cloud(&mut random, 150).iter().map(|p| seen(p) + DVec3::new(0.0, 25.0, 0.0)));
        let registration = Registration { centres: &centres, tree: NearestPoint::of(&centres), points };
        let near = Similarity { rotation: DMat3::from_rotation_x(0.03), scale: 1.01, ..Similarity::IDENTITY };
        let start = to.after(&near);
        assert!(registration.residual(&start) > 0.1);
        let found = registration.refined(&start);
        assert!(off(&found, &to) < 1e-3, "{}", off(&found, &to));
        assert!(registration.residual(&found) < 1e-4);
    }
}
