//! Means over square windows of an image.

use crate::pieces::task_rows;
use rayon::prelude::*;

/// Mean of each pixel over a square window of half width `r`, cut off at the border; row-major.
pub fn box_mean(values: &[f32], width: usize, height: usize, r: usize) -> Vec<f32> {
    let mut rows = vec![0.0f32; values.len()];
    let inner = r.min(width)..width.saturating_sub(r).max(r.min(width));
    let (lines, task) = (values.par_chunks_exact(width), task_rows(width));
    let lines = lines.zip(rows.par_chunks_exact_mut(width)).with_min_len(task);
    lines.for_each(|(row, means)| {
        for x in (0..inner.start).chain(inner.end..width) {
            let (a, b) = (x.saturating_sub(r), (x + r + 1).min(width));
            means[x] = row[a..b].iter().sum::<f32>() / (b - a) as f32;
        }
        if inner.is_empty() {
            return;
        }
        // Whole windows, a shifted row at a time.
        let means = &mut means[inner.clone()];
        for shift in 0..2 * r + 1 {
            for (m, v) in means.iter_mut().zip(&row[shift..]) {
                *m += v;
            }
        }
        means.iter_mut().for_each(|m| *m /= (2 * r + 1) as f32);
    });
    let mut out = vec![0.0f32; values.len()];
    let lines = out.par_chunks_exact_mut(width).with_min_len(task).enumerate();
    lines.for_each(|(y, line)| {
        let (a, b) = (y.saturating_sub(r), (y + r + 1).min(height));
        for k in a..b {
            for (o, v) in line.iter_mut().zip(&rows[k * width..(k + 1) * width]) {
                *o += v;
            }
        }
        for o in line {
            *o /= (b - a) as f32;
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_is_cut_off_at_the_border() {
        let values: Vec<f32> = (0..12).map(|i| i as f32).collect();
        let means = box_mean(&values, 4, 3, 1);
        assert_eq!(means[0], (0.0 + 1.0 + 4.0 + 5.0) / 4.0);
        assert_eq!(means[5], (0.0 + 1.0 + 2.0 + 4.0 + 5.0 + 6.0 + 8.0 + 9.0 + 10.0) / 9.0);
        assert!(box_mean(&values, 4, 3, 9).iter().all(|m| (m - 5.5).abs() < 1e-6), "wider than the image");
    }
}
