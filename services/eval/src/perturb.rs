//! NeRF-W's perturbations of a clean set: another colour for each photo, and a striped square in front of it
//! (Martin-Brualla et al. 2021, the `lego` experiment; method, section 11).

use segwild_scene::{Image, Mask};
use segwild_synthetic::random::Rng;
use serde::{Deserialize, Serialize};

/// Side of the square in pixels on the experiment's photos, which are 800 x 800; on others it has the same share of the
/// long side.
pub const SQUARE: usize = 200;
/// Long side of the experiment's photos.
const PHOTO: usize = 800;
/// Number of its upright stripes, 20 px wide each in the experiment.
pub const STRIPES: usize = 10;

/// Side of the square on a photo.
fn side(width: usize, height: usize) -> usize {
    (width.max(height) * SQUARE / PHOTO).max(STRIPES)
}

/// Why a photo cannot be perturbed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PerturbError {
    /// The photo is smaller than the square.
    #[error("a photo of {width}x{height} is too small for a square of a quarter of its long side")]
    Small {
        /// Width of the photo.
        width: usize,
        /// Height of the photo.
        height: usize,
    },
    /// The photo is not a colour image.
    #[error("a photo has three planes, not {0}")]
    Planes(usize),
}

/// A colour rule: `c' = clip(scale c + shift)` per plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AffineColours {
    /// Factor per plane.
    pub scale: [f32; 3],
    /// Addend per plane.
    pub shift: [f32; 3],
}

impl AffineColours {
    /// The rule of one photo: scale uniform in [0.8, 1.2], shift in [-0.2, 0.2], plane by plane.
    pub fn random(seed: u64, photo: u64) -> AffineColours {
        let mut rng = Rng::new(seed, (11 << 32) + photo);
        AffineColours { scale: rng.triple(0.8, 1.2).to_array(), shift: rng.triple(-0.2, 0.2).to_array() }
    }

    /// The photo under the rule.
    pub fn apply(&self, image: &Image) -> Result<Image, PerturbError> {
        if image.channels != 3 {
            return Err(PerturbError::Planes(image.channels));
        }
        let mut out = image.clone();
        for c in 0..3 {
            for v in out.plane_mut(c) {
                *v = (*v * self.scale[c] + self.shift[c]).clamp(0.0, 1.0);
            }
        }
        Ok(out)
    }
}

/// A striped square on a photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StripedSquare {
    /// Its left column.
    pub left: usize,
    /// Its top row.
    pub top: usize,
    /// Its side in pixels.
    pub side: usize,
    /// The stripes' colours, from the left.
    pub stripes: Vec<[f32; 3]>,
}

impl StripedSquare {
    /// The square of one photo: anywhere it fits, in random colours.
    pub fn random(seed: u64, photo: u64, width: usize, height: usize) -> Result<StripedSquare, PerturbError> {
        let side = side(width, height);
        if width < side || height < side {
            return Err(PerturbError::Small { width, height });
        }
        let mut rng = Rng::new(seed, (13 << 32) + photo);
        Ok(StripedSquare {
            left: rng.below(width - side + 1),
            top: rng.below(height - side + 1),
            side,
            stripes: (0..STRIPES).map(|_| rng.triple(0.0, 1.0).to_array()).collect(),
        })
    }

    /// The photo under the square, and the square's pixels.
    pub fn apply(&self, image: &Image) -> Result<(Image, Mask), PerturbError> {
        if image.channels != 3 {
            return Err(PerturbError::Planes(image.channels));
        }
        let (width, height) = (image.width, image.height);
        if self.left + self.side > width || self.top + self.side > height {
            return Err(PerturbError::Small { width, height });
        }
        let mut out = image.clone();
        for (c, y) in (0..3).flat_map(|c| (self.top..self.top + self.side).map(move |y| (c, y))) {
            for x in 0..self.side {
                let stripe = self.stripes[x * self.stripes.len() / self.side];
                out.data[(c * height + y) * width + self.left + x] = stripe[c];
            }
        }
        let inside = |x: u32, y: u32| {
            (self.left..self.left + self.side).contains(&(x as usize))
                && (self.top..self.top + self.side).contains(&(y as usize))
        };
        Ok((out, Mask::from_fn(width as u32, height as u32, inside)))
    }
}

/// A training photo of the experiment: the colour rule first, the square over it. Test photos stay clean.
pub fn lego(image: &Image, seed: u64, photo: u64) -> Result<(Image, Mask), PerturbError> {
    let square = StripedSquare::random(seed, photo, image.width, image.height)?;
    square.apply(&AffineColours::random(seed, photo).apply(image)?)
}
