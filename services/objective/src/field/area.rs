//! From the render's grid to the embedding's and back.

use segwild_scene::Image;

/// Area averaging from one size to another, separable, and its transpose.
///
/// An embedding cell describes the pixels under it, so the average of a render over these pixels is compared with it.
/// This leaves the features free to be sharper than the embedding.
#[derive(Clone, Debug)]
pub struct AreaAverage {
    columns: Vec<Window>,
    rows: Vec<Window>,
    from: (usize, usize),
}

/// Which inputs an output averages, and their weights (which sum to 1).
#[derive(Clone, Debug)]
pub struct Window {
    /// The first of them.
    pub start: usize,
    /// One per input.
    pub weights: Vec<f32>,
}

impl AreaAverage {
    /// From a width and height to another.
    pub fn new(from: (usize, usize), to: (usize, usize)) -> AreaAverage {
        AreaAverage { columns: windows(from.0, to.0), rows: windows(from.1, to.1), from }
    }

    /// Which columns of the input a column of the output averages, and their weights.
    pub fn columns(&self) -> &[Window] {
        &self.columns
    }

    /// The same of rows.
    pub fn rows(&self) -> &[Window] {
        &self.rows
    }

    /// Width and height of the input.
    pub fn from(&self) -> (usize, usize) {
        self.from
    }

    /// And of the averages.
    pub fn to(&self) -> (usize, usize) {
        (self.columns.len(), self.rows.len())
    }

    /// Averages every plane.
    pub fn forward(&self, image: &Image) -> Image {
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
    pub fn transposed(&self, image: &Image, factor: f32, out: &mut Image) {
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
}
