//! A photo as images are compared with it.

use segwild_scene::{Image, in_pieces};

/// A photo at the size of a comparison, with flags and trust per pixel.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhotoTarget {
    /// Pixels across.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Red, green, blue and flags ([`PhotoTarget::COUNTS`] and the others), row by row.
    pub pixels: Vec<[u8; 4]>,
    /// Trust that each pixel shows the static scene, in [0, 1]: its residual counts that much less towards transients.
    /// Empty: 0 everywhere.
    pub trust: Vec<f32>,
}

impl PhotoTarget {
    /// Takes part in the colour loss: may be trained on, and is no sky.
    pub const COUNTS: u8 = 1;
    /// Is sky.
    pub const SKY: u8 = 2;
    /// Is sky, and so are its four neighbours: the border of a sky mask is the part that is wrong.
    pub const INNER: u8 = 4;
    /// Is an initial transient: masked as transient before training.
    pub const INITIAL_TRANSIENT: u8 = 8;

    /// Whether a pixel has a flag.
    #[inline]
    pub fn is(&self, i: usize, flag: u8) -> bool {
        self.pixels[i][3] & flag != 0
    }

    /// A pixel's colour in [0, 1].
    #[inline]
    pub fn colour(&self, i: usize) -> [f32; 3] {
        let [r, g, b, _] = self.pixels[i];
        [r, g, b].map(|v| f32::from(v) * (1.0 / 255.0))
    }

    /// The colours, three planes.
    pub fn image(&self) -> Image {
        let mut image = Image::zeros(self.width, self.height, 3);
        for c in 0..3 {
            in_pieces(image.plane_mut(c), |first, piece| {
                let pixels = piece.iter_mut().zip(&self.pixels[first..]);
                pixels.for_each(|(v, p)| *v = f32::from(p[c]) * (1.0 / 255.0));
            });
        }
        image
    }

    /// A residual times one minus the trust of its pixel.
    pub fn uncertain(&self, residual: &[f32]) -> Vec<f32> {
        if self.trust.is_empty() {
            return residual.to_vec();
        }
        untrusted(residual, &self.trust)
    }
}

/// Residuals per pixel, each times one minus the trust of its pixel.
pub fn untrusted(residual: &[f32], trust: &[f32]) -> Vec<f32> {
    let mut out = residual.to_vec();
    in_pieces(&mut out, |first, piece| {
        piece.iter_mut().zip(&trust[first..]).for_each(|(r, t)| *r *= 1.0 - t);
    });
    out
}
