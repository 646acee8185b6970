//! Which photos a photo is compared with.

use crate::frame::StereoFrame;
use segwild_scene::Scene;

/// Best angle between the rays of two photos to a point, in degrees: with a smaller one depth is uncertain, with a larger one photos show different sides.
const ANGLE: f32 = 8.0;
/// Deviations below and above it.
const SPREAD: (f32, f32) = (3.0, 15.0);

/// For each frame up to `most` others that saw the same points under good angles, best first.
pub(crate) fn sources(scene: &Scene, frames: &[StereoFrame], most: usize) -> Vec<Vec<usize>> {
    let n = frames.len();
    let mut of_view = vec![None; scene.views.len()];
    frames.iter().enumerate().for_each(|(i, f)| of_view[f.view] = Some(i));
    let centres: Vec<_> = frames.iter().map(|f| f.pose.centre()).collect();
    let mut scores = vec![0.0f32; n * n];
    for point in &scene.points {
        let seen: Vec<usize> = point.track.iter().filter_map(|o| of_view[o.view as usize]).collect();
        for (k, &i) in seen.iter().enumerate() {
            for &j in &seen[k + 1..] {
                let (a, b) = (centres[i] - point.position, centres[j] - point.position);
                let angle = a.angle_between(b).to_degrees();
                let deviation = if angle < ANGLE { SPREAD.0 } else { SPREAD.1 };
                // Photos from much nearer or farther show it at another size.
                let size = |v: usize, d: f32| frames[v].fine.camera.fx / d.max(1e-6);
                let (s, t) = (size(i, a.length()), size(j, b.length()));
                let worth = (-0.5 * ((angle - ANGLE) / deviation).powi(2)).exp() * (s.min(t) / s.max(t));
                if worth.is_finite() {
                    scores[i * n + j] += worth;
                    scores[j * n + i] += worth;
                }
            }
        }
    }
    (0..n)
        .map(|i| {
            let row = &scores[i * n..(i + 1) * n];
            let mut order: Vec<usize> = (0..n).filter(|&j| row[j] > 0.0).collect();
            order.sort_by(|&a, &b| row[b].total_cmp(&row[a]).then(a.cmp(&b)));
            order.truncate(most);
            order
        })
        .collect()
}
