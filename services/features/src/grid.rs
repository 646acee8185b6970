//! Images between the render's grid and the embedding's.

use segwild_scene::Image;

/// Area averaging from one size to another, separable, and its transpose.
///
/// An embedding cell speaks for the pixels under it, so a render is compared with it by its average there:
/// this leaves the features free to be sharper than the embedding.
#[derive(Clone, Debug)]
pub(crate) struct AreaAverage {
    columns: Vec<Window>,
    rows: Vec<Window>,
    from: (usize, usize),
}

/// Which inputs an output averages, and their weights (which sum to 1).
#[derive(Clone, Debug)]
struct Window {
    start: usize,
    weights: Vec<f32>,
}

impl AreaAverage {
    pub(crate) fn new(from: (usize, usize), to: (usize, usize)) -> AreaAverage {
        AreaAverage { columns: windows(from.0, to.0), rows: windows(from.1, to.1), from }
    }

    fn to(&self) -> (usize, usize) {
        (self.columns.len(), self.rows.len())
    }

    /// Averages every plane.
    pub(crate) fn forward(&self, image: &Image) -> Image {
        let (w, h) = self.to();
        if (w, h) == self.from {
            return image.clone();
        }
        let mut out = Image::zeros(w, h, image.channels);
        let mut row = vec![0.0; self.from.0];
        for c in 0..image.channels {
            let plane = image.plane(c);
            for (y, window) in self.rows.iter().enumerate() {
                row.fill(0.0);
                for (k, weight) in window.weights.iter().enumerate() {
                    let line = &plane[(window.start + k) * self.from.0..][..self.from.0];
                    row.iter_mut().zip(line).for_each(|(r, v)| *r += weight * v);
                }
                let out = &mut out.plane_mut(c)[y * w..(y + 1) * w];
                for (out, window) in out.iter_mut().zip(&self.columns) {
                    let inputs = &row[window.start..][..window.weights.len()];
                    *out = inputs.iter().zip(&window.weights).map(|(v, w)| v * w).sum();
                }
            }
        }
        out
    }

    /// Adds the transpose of [`AreaAverage::forward`], times `factor`, to `out`.
    pub(crate) fn transposed(&self, image: &Image, factor: f32, out: &mut Image) {
        let (w, _) = self.to();
        let mut row = vec![0.0; self.from.0];
        for c in 0..image.channels {
            let plane = image.plane(c);
            for (y, window) in self.rows.iter().enumerate() {
                row.fill(0.0);
                for (v, window) in plane[y * w..(y + 1) * w].iter().zip(&self.columns) {
                    for (r, weight) in row[window.start..].iter_mut().zip(&window.weights) {
                        *r += v * weight * factor;
                    }
                }
                for (k, weight) in window.weights.iter().enumerate() {
                    let line = &mut out.plane_mut(c)[(window.start + k) * self.from.0..][..self.from.0];
                    line.iter_mut().zip(&row).for_each(|(o, r)| *o += weight * r);
                }
            }
        }
    }
}

/// The share of each input cell in each output cell along one axis.
fn windows(from: usize, to: usize) -> Vec<Window> {
    let step = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            let (low, high) = (i as f64 * step, (i + 1) as f64 * step);
            let start = (low as usize).min(from - 1);
            let end = (high.ceil() as usize).clamp(start + 1, from);
            let cover = |k: usize| (high.min((k + 1) as f64) - low.max(k as f64)).max(0.0);
            let total: f64 = (start..end).map(cover).sum();
            let weights = (start..end).map(|k| (cover(k) / total) as f32).collect();
            Window { start, weights }
        })
        .collect()
}

/// Bilinear interpolation between cell centres; beyond the outermost centres the border cell holds.
pub(crate) fn bilinear(image: &Image, width: usize, height: usize) -> Image {
    if (image.width, image.height) == (width, height) {
        return image.clone();
    }
    let taps = |from: usize, to: usize| -> Vec<(usize, usize, f32)> {
        (0..to)
            .map(|i| {
                let at = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
                (at as usize, (at as usize + 1).min(from - 1), at.fract() as f32)
            })
            .collect()
    };
    let (columns, rows) = (taps(image.width, width), taps(image.height, height));
    let mut out = Image::zeros(width, height, image.channels);
    let mut row = vec![0.0; image.width];
    for c in 0..image.channels {
        let plane = image.plane(c);
        let line = |y: usize| &plane[y * image.width..(y + 1) * image.width];
        for (y, &(above, below, t)) in rows.iter().enumerate() {
            for (r, (a, b)) in row.iter_mut().zip(line(above).iter().zip(line(below))) {
                *r = a + t * (b - a);
            }
            let out = &mut out.plane_mut(c)[y * width..(y + 1) * width];
            for (out, &(left, right, t)) in out.iter_mut().zip(&columns) {
                *out = row[left] + t * (row[right] - row[left]);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Random;

    #[test]
    fn averages_and_their_transpose_agree() {
        let mut random = Random::new(3);
        for (from, to) in
            [((13, 9), (5, 4)), ((8, 8), (4, 2)), ((4, 3), (9, 7)), ((5, 5), (5, 5)), ((7, 1), (1, 1))]
        {
            let mut noise = |(w, h): (usize, usize)| Image {
                width: w,
                height: h,
                channels: 2,
                data: (0..w * h * 2).map(|_| random.normal()).collect(),
            };
            let (x, y) = (noise(from), noise(to));
            let average = AreaAverage::new(from, to);
            let forward = average.forward(&x);
            let mut back = Image::zeros(from.0, from.1, 2);
            average.transposed(&y, 2.0, &mut back);
            let dot = |a: &Image, b: &Image| -> f64 {
                a.data.iter().zip(&b.data).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
            };
            assert!((2.0 * dot(&forward, &y) - dot(&x, &back)).abs() < 1e-4, "{from:?} {to:?}");
            // The mean is kept, and so is a constant.
            let mean = |i: &Image| i.data.iter().sum::<f32>() / i.data.len() as f32;
            assert!((mean(&forward) - mean(&x)).abs() < 1e-5, "{from:?} {to:?}");
            let flat = average.forward(&Image::filled(from.0, from.1, 1, 3.0));
            assert!(flat.data.iter().all(|v| (v - 3.0).abs() < 1e-5));
        }
        let halves = AreaAverage::new((4, 1), (2, 1)).forward(&Image {
            width: 4,
            height: 1,
            channels: 1,
            data: vec![1.0, 3.0, 5.0, 9.0],
        });
        assert_eq!(halves.data, [2.0, 7.0]);
    }

    #[test]
    fn bilinear_keeps_ramps_and_borders() {
        let ramp =
            Image { width: 4, height: 2, channels: 1, data: vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0] };
        let up = bilinear(&ramp, 8, 4);
        assert_eq!(up.data[..8], [0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.0]);
        assert_eq!(up.at(0, 0, 3), 4.0);
        assert_eq!(bilinear(&ramp, 4, 2), ramp);
        assert!(bilinear(&Image::filled(1, 1, 3, 2.0), 5, 7).data.iter().all(|&v| v == 2.0));
    }
}
