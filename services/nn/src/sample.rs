//! Reading maps at points.

use crate::map::Map;

/// A point on a map for bilinear sampling: four pixels and their weights. Coordinates are clamped to the border.
#[derive(Clone, Copy, Debug)]
pub struct BilinearSample {
    at: [usize; 4],
    weight: [f32; 4],
    /// Share of the way to the right and lower pixels, and pixels per unit of the coordinate, 0 where the border holds.
    share: [f32; 2],
    slope: [f32; 2],
}

impl BilinearSample {
    /// The point at `x`, `y`, where [-1, 1] spans the outer pixels' centres of a map of that size. NaN is taken as the
    /// middle.
    pub fn new(width: usize, height: usize, [x, y]: [f32; 2]) -> BilinearSample {
        let axis = |v: f32, n: usize| -> (usize, f32, f32) {
            let most = (n - 1) as f32;
            let v = if v.is_nan() { 0.0 } else { v };
            let p = (v + 1.0) * 0.5 * most;
            let held = p.clamp(0.0, most);
            let low = (held as usize).min(n.saturating_sub(2));
            (low, held - low as f32, if p == held { 0.5 * most } else { 0.0 })
        };
        let ((x0, fx, sx), (y0, fy, sy)) = (axis(x, width), axis(y, height));
        let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
        BilinearSample {
            at: [y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1],
            weight: [(1.0 - fy) * (1.0 - fx), (1.0 - fy) * fx, fy * (1.0 - fx), fy * fx],
            share: [fx, fy],
            slope: [sx, sy],
        }
    }

    /// Reads `out.len()` numbers per pixel from `[pixel][number]`.
    pub fn read(&self, pixels: &[f32], out: &mut [f32]) {
        let n = out.len();
        let [a, b, c, d] = self.at.map(|p| &pixels[p * n..(p + 1) * n]);
        let w = self.weight;
        for (k, to) in out.iter_mut().enumerate() {
            *to = w[0] * a[k] + w[1] * b[k] + w[2] * c[k] + w[3] * d[k];
        }
    }

    /// Adds the gradient of the numbers read to that of the pixels.
    pub fn add(&self, grad: &[f32], pixels: &mut [f32]) {
        let n = grad.len();
        for (p, w) in self.at.iter().zip(self.weight) {
            for (to, g) in pixels[p * n..(p + 1) * n].iter_mut().zip(grad) {
                *to += w * g;
            }
        }
    }

    /// Gradient of the coordinates.
    pub fn slope(&self, grad: &[f32], pixels: &[f32]) -> [f32; 2] {
        let n = grad.len();
        let [a, b, c, d] = self.at.map(|p| {
            let pixel = &pixels[p * n..(p + 1) * n];
            pixel.iter().zip(grad).map(|(v, g)| v * g).sum::<f32>()
        });
        let [fx, fy] = self.share;
        let across = (1.0 - fy) * (b - a) + fy * (d - c);
        let down = (1.0 - fx) * (c - a) + fx * (d - b);
        [across * self.slope[0], down * self.slope[1]]
    }
}

/// The planes `from..from + count` of a map, as `[pixel][number]`, the layout that [`BilinearSample::read`] takes.
pub fn take(map: &Map, from: usize, count: usize) -> Vec<f32> {
    let mut out = vec![0.0; map.pixels() * count];
    for c in 0..count {
        for (to, v) in out[c..].iter_mut().step_by(count).zip(map.plane(from + c)) {
            *to = *v;
        }
    }
    out
}

/// The opposite of [`take`]: writes `[pixel][number]` into planes.
pub fn scatter(pixels: &[f32], map: &mut Map, from: usize, count: usize) {
    let n = map.pixels();
    for c in 0..count {
        let plane = &mut map.data[(from + c) * n..(from + c + 1) * n];
        for (to, v) in plane.iter_mut().zip(pixels[c..].iter().step_by(count)) {
            *to = *v;
        }
    }
}
