//! Small filters over one plane: blur, derivatives, pyramid steps.

use segwild_scene::statistics::quantile;

/// One plane of numbers, row-major.
#[derive(Clone, Debug)]
pub(crate) struct FloatPlane {
    pub width: usize,
    pub height: usize,
    pub data: Vec<f32>,
}

/// Where tap `i` of a mirrored row of `n` lies; the edge sample is repeated, as `abc|cba`.
fn mirror(i: isize, n: usize) -> usize {
    let n = n as isize;
    let m = i.rem_euclid(2 * n);
    (if m < n { m } else { 2 * n - 1 - m }) as usize
}

/// Taps of a Gaussian of `sigma` pixels that sum to 1.
fn gaussian(sigma: f32) -> Vec<f32> {
    let radius = (2.6 * sigma).ceil().max(1.0) as isize;
    let taps: Vec<f32> =
        (-radius..=radius).map(|i| (-(i * i) as f32 / (2.0 * sigma * sigma)).exp()).collect();
    let sum: f32 = taps.iter().sum();
    taps.iter().map(|t| t / sum).collect()
}

impl FloatPlane {
    pub fn new(width: usize, height: usize, data: Vec<f32>) -> FloatPlane {
        debug_assert_eq!(data.len(), width * height);
        FloatPlane { width, height, data }
    }

    pub fn zeros(width: usize, height: usize) -> FloatPlane {
        FloatPlane { width, height, data: vec![0.0; width * height] }
    }

    /// Gaussian blur, mirrored at the frame.
    pub fn blurred(&self, sigma: f32) -> FloatPlane {
        let taps = gaussian(sigma);
        let radius = (taps.len() / 2) as isize;
        let (w, h) = (self.width, self.height);
        let mut rows = FloatPlane::zeros(w, h);
        // Down the columns first: whole rows are added, which vectorises.
        for y in 0..h {
            let out = &mut rows.data[y * w..(y + 1) * w];
            for (k, &t) in taps.iter().enumerate() {
                let sy = mirror(y as isize + k as isize - radius, h);
                for (o, &v) in out.iter_mut().zip(&self.data[sy * w..(sy + 1) * w]) {
                    *o += t * v;
                }
            }
        }
        let mut out = FloatPlane::zeros(w, h);
        let r = radius as usize;
        let mut padded = vec![0.0; w + 2 * r];
        for y in 0..h {
            let row = &rows.data[y * w..(y + 1) * w];
            padded[r..r + w].copy_from_slice(row);
            for i in 0..r {
                padded[i] = row[mirror(i as isize - radius, w)];
                padded[r + w + i] = row[mirror((w + i) as isize, w)];
            }
            let line = &mut out.data[y * w..(y + 1) * w];
            for (k, &t) in taps.iter().enumerate() {
                for (o, &v) in line.iter_mut().zip(&padded[k..k + w]) {
                    *o += t * v;
                }
            }
        }
        out
    }

    /// Central differences (d/dx, d/dy), one-sided at the frame.
    pub fn gradient(&self) -> (FloatPlane, FloatPlane) {
        let (w, h) = (self.width, self.height);
        let (mut dx, mut dy) = (FloatPlane::zeros(w, h), FloatPlane::zeros(w, h));
        for y in 0..h {
            let row = &self.data[y * w..(y + 1) * w];
            let line = &mut dx.data[y * w..(y + 1) * w];
            for x in 1..w.saturating_sub(1) {
                line[x] = 0.5 * (row[x + 1] - row[x - 1]);
            }
            if w > 1 {
                line[0] = 0.5 * (row[1] - row[0]);
                line[w - 1] = 0.5 * (row[w - 1] - row[w - 2]);
            }
            let (above, below) = (y.saturating_sub(1), (y + 1).min(h - 1));
            let (above, below) =
                (&self.data[above * w..(above + 1) * w], &self.data[below * w..(below + 1) * w]);
            for (o, (a, b)) in dy.data[y * w..(y + 1) * w].iter_mut().zip(above.iter().zip(below)) {
                *o = 0.5 * (b - a);
            }
        }
        (dx, dy)
    }

    /// Half the size (rounded up), each pixel the mean of the up to four under it.
    pub fn halved(&self) -> FloatPlane {
        let (w, h) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut out = FloatPlane::zeros(w, h);
        for y in 0..h {
            let (y0, y1) = (2 * y, (2 * y + 1).min(self.height - 1));
            for x in 0..w {
                let (x0, x1) = (2 * x, (2 * x + 1).min(self.width - 1));
                out.data[y * w + x] = 0.25
                    * (self.data[y0 * self.width + x0]
                        + self.data[y0 * self.width + x1]
                        + self.data[y1 * self.width + x0]
                        + self.data[y1 * self.width + x1]);
            }
        }
        out
    }

    /// Another size by bilinear interpolation; pixel centres at half units, clamped at the frame.
    pub fn resized(&self, width: usize, height: usize) -> FloatPlane {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let axis = |n: usize, m: usize| -> Vec<(usize, usize, f32)> {
            (0..n)
                .map(|i| {
                    let u = ((i as f32 + 0.5) * m as f32 / n as f32 - 0.5).clamp(0.0, (m - 1) as f32);
                    let j = u as usize;
                    (j, (j + 1).min(m - 1), u - j as f32)
                })
                .collect()
        };
        let (xs, ys) = (axis(width, self.width), axis(height, self.height));
        let mut out = FloatPlane::zeros(width, height);
        for (y, &(y0, y1, fy)) in ys.iter().enumerate() {
            let (a, b) = (&self.data[y0 * self.width..], &self.data[y1 * self.width..]);
            for (o, &(x0, x1, fx)) in out.data[y * width..(y + 1) * width].iter_mut().zip(&xs) {
                let top = a[x0] + fx * (a[x1] - a[x0]);
                let low = b[x0] + fx * (b[x1] - b[x0]);
                *o = top + fy * (low - top);
            }
        }
        out
    }

    /// The same plane if it has that size, else means over the cells of that grid.
    pub fn pooled_to(self, width: usize, height: usize) -> FloatPlane {
        if (width, height) == (self.width, self.height) { self } else { self.pooled(width, height) }
    }

    /// Means over the cells of a coarser grid that covers the plane edge to edge.
    pub fn pooled(&self, width: usize, height: usize) -> FloatPlane {
        let mut out = FloatPlane::zeros(width, height);
        for cy in 0..height {
            let (y0, y1) = span(cy, height, self.height);
            for cx in 0..width {
                let (x0, x1) = span(cx, width, self.width);
                let mut sum = 0.0;
                for y in y0..y1 {
                    sum += self.data[y * self.width + x0..y * self.width + x1].iter().sum::<f32>();
                }
                out.data[cy * width + cx] = sum / ((y1 - y0) * (x1 - x0)) as f32;
            }
        }
        out
    }

    /// Value at quantile `q` in [0, 1], by the nearest rank.
    ///
    /// # Panics
    /// Without pixels.
    pub fn quantile(&self, q: f32) -> f32 {
        quantile(self.data.clone(), q).expect("a plane has pixels")
    }
}

/// Pixels `from..to` of an axis of `n` that cell `i` of `cells` covers; at least one.
pub(crate) fn span(i: usize, cells: usize, n: usize) -> (usize, usize) {
    let from = (i * n / cells).min(n - 1);
    (from, ((i + 1) * n / cells).clamp(from + 1, n))
}
