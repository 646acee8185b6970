//! The distance of two images in the features of one layer: at each pixel the features are divided by their length, and the
//! squared differences are summed with a weight per channel (Zhang et al. 2018, equation 1).

use crate::map::Map;
use rayon::prelude::*;
use std::ops::Range;

/// Added to lengths before features are divided by them, as the package `lpips` does.
const EPSILON: f32 = 1e-10;

/// Numbers per pixel of a row.
struct RowLengths {
    /// One over the length of the render's features.
    render: Vec<f32>,
    /// The same of the target's.
    target: Vec<f32>,
    /// The gradient's part along the render's features, over their length; empty where none is wanted.
    along: Vec<f32>,
    /// Sum of the row's distances.
    sum: f64,
}

/// Sum of the distances at the pixels of the given rows and columns, and the gradient of that sum, times `scale`, by the
/// features of the render where it is wanted.
pub(super) fn head(
    [render, target]: [&Map; 2],
    weights: &[f32],
    [rows, columns]: [Range<usize>; 2],
    scale: Option<f32>,
) -> (f64, Option<Map>) {
    let row = |y: usize| row_lengths([render, target], weights, y, columns.clone(), scale.is_some());
    let lengths: Vec<RowLengths> = rows.clone().into_par_iter().map(row).collect();
    let sum = lengths.iter().map(|row| row.sum).sum();
    let grad = scale.map(|scale| {
        let mut grad = Map::zeros(render.channels, render.height, render.width);
        let n = grad.pixels().max(1);
        grad.data.par_chunks_exact_mut(n).enumerate().for_each(|(c, plane)| {
            let factor = 2.0 * weights[c];
            for (y, row) in rows.clone().zip(&lengths) {
                let span = y * render.width + columns.start..y * render.width + columns.end;
                let (r, t) = (&render.plane(c)[span.clone()], &target.plane(c)[span.clone()]);
                for (x, out) in plane[span].iter_mut().enumerate() {
                    let difference = r[x] * row.render[x] - t[x] * row.target[x];
                    *out = scale * row.render[x] * (factor * difference - r[x] * row.along[x]);
                }
            }
        });
        grad
    });
    (sum, grad)
}

fn row_lengths(
    [render, target]: [&Map; 2],
    weights: &[f32],
    y: usize,
    columns: Range<usize>,
    wanted: bool,
) -> RowLengths {
    let n = columns.len();
    let span = y * render.width + columns.start..y * render.width + columns.end;
    let squares = |map: &Map| {
        let mut sums = vec![0.0f32; n];
        for c in 0..map.channels {
            sums.iter_mut().zip(&map.plane(c)[span.clone()]).for_each(|(sum, v)| *sum += v * v);
        }
        sums
    };
    let inverse = |squares: &[f32]| squares.iter().map(|s| 1.0 / (s.sqrt() + EPSILON)).collect();
    let (of_render, of_target) = (squares(render), squares(target));
    let (by_render, by_target): (Vec<f32>, Vec<f32>) = (inverse(&of_render), inverse(&of_target));
    let (mut sums, mut along) = (vec![0.0f32; n], vec![0.0f32; n]);
    for c in 0..render.channels {
        let (r, t) = (&render.plane(c)[span.clone()], &target.plane(c)[span.clone()]);
        for x in 0..n {
            let difference = r[x] * by_render[x] - t[x] * by_target[x];
            sums[x] += weights[c] * difference * difference;
            along[x] += 2.0 * weights[c] * difference * r[x];
        }
    }
    let along = if wanted {
        // The length changes with the features: d(1 / (s + epsilon)) = - f df / (s (s + epsilon)^2), and not where s is 0.
        let scaled =
            |((a, s), inverse): ((&f32, &f32), &f32)| if *s > 0.0 { a * inverse / s.sqrt() } else { 0.0 };
        along.iter().zip(&of_render).zip(&by_render).map(scaled).collect()
    } else {
        Vec::new()
    };
    let sum = sums.iter().map(|v| f64::from(*v)).sum();
    RowLengths { render: by_render, target: by_target, along, sum }
}
