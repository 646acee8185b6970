//! sRGB to CIE L*a*b* (D65), and one photo's colours made comparable with another's.

use super::plane::FloatPlane;
use segwild_scene::Image;

/// A photo in CIE L*a*b*: L in 0..100, a and b about -80..80.
#[derive(Clone, Debug)]
pub(crate) struct Lab {
    pub l: FloatPlane,
    pub a: FloatPlane,
    pub b: FloatPlane,
}

fn linear(v: f32) -> f32 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

fn curve(t: f32) -> f32 {
    if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 }
}

impl Lab {
    /// Converts sRGB in [0, 1]. What is not finite counts as black.
    pub fn of(image: &Image) -> Lab {
        let (w, h, n) = (image.width, image.height, image.pixels());
        // 4096 steps are finer than any photo's 256.
        let table: Vec<f32> = (0..4096).map(|i| linear(i as f32 / 4095.0)).collect();
        let read =
            |v: f32| if v.is_finite() { table[(v.clamp(0.0, 1.0) * 4095.0 + 0.5) as usize] } else { 0.0 };
        let (mut l, mut a, mut b) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        let (red, green, blue) = (image.plane(0), image.plane(1), image.plane(2));
        for i in 0..n {
            let (r, g, bl) = (read(red[i]), read(green[i]), read(blue[i]));
            let x = curve((0.412_456 * r + 0.357_576 * g + 0.180_438 * bl) / 0.950_47);
            let y = curve(0.212_673 * r + 0.715_152 * g + 0.072_175 * bl);
            let z = curve((0.019_334 * r + 0.119_192 * g + 0.950_304 * bl) / 1.088_83);
            l[i] = 116.0 * y - 16.0;
            a[i] = 500.0 * (x - y);
            b[i] = 200.0 * (y - z);
        }
        Lab { l: FloatPlane::new(w, h, l), a: FloatPlane::new(w, h, a), b: FloatPlane::new(w, h, b) }
    }

    /// The photo with its own exposure and contrast taken out, about 0..1 per plane: lightness between its
    /// 2 % and 98 % quantiles; chroma about neutral grey, scaled by its spread. A floor on the spreads keeps a flat
    /// photo flat.
    pub fn normalised(&self) -> Lab {
        let (low, high) = (self.l.quantile(0.02), self.l.quantile(0.98));
        let range = (high - low).max(30.0);
        let middle = 0.5 * (low + high);
        let spread = |p: &FloatPlane| p.quantile(0.98) - p.quantile(0.02);
        let chroma = spread(&self.a).max(spread(&self.b)).max(30.0);
        let map = |p: &FloatPlane, f: &dyn Fn(f32) -> f32| {
            FloatPlane::new(p.width, p.height, p.data.iter().map(|&v| f(v).clamp(0.0, 1.0)).collect())
        };
        let (ma, mb) = (self.a.quantile(0.5), self.b.quantile(0.5));
        Lab {
            l: map(&self.l, &|v| 0.5 + (v - middle) / range),
            a: map(&self.a, &|v| 0.5 + (v - ma) / (1.6 * chroma)),
            b: map(&self.b, &|v| 0.5 + (v - mb) / (1.6 * chroma)),
        }
    }
}
