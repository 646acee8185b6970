//! How far numbers of the device may lie from those of the host.

use crate::mismatch::Mismatch;

/// How far numbers may lie apart, in units of their size plus the array's root mean square.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    /// For all but a share.
    pub tight: f32,
    /// That share: values at a cut-off may fall on either side.
    pub flips: f32,
    /// For all.
    pub loose: f32,
}

impl Tolerance {
    /// Depths, radii, centres.
    pub const PROJECTED: Tolerance = Tolerance { tight: 1e-4, flips: 0.0, loose: 1e-4 };
    /// Images.
    pub const BLENDED: Tolerance = Tolerance { tight: 5e-5, flips: 0.01, loose: 0.02 };
    /// Sums over pixels.
    pub const GRADIENTS: Tolerance = Tolerance { tight: 5e-4, flips: 0.01, loose: 0.1 };

    /// Compares an array of the device with the host's. `what` names it.
    ///
    /// # Errors
    /// The difference, if it exceeds the tolerance.
    pub fn compare(&self, what: &str, got: &[f32], wanted: &[f32]) -> Result<(), Mismatch> {
        let number = |index: usize| Mismatch::Number {
            what: what.into(),
            index,
            got: got[index],
            wanted: wanted[index],
        };
        if got.len() != wanted.len() {
            return Err(Mismatch::Length { what: what.into(), got: got.len(), wanted: wanted.len() });
        }
        let squares = wanted.iter().map(|w| f64::from(*w).powi(2)).sum::<f64>();
        let rms = (squares / wanted.len().max(1) as f64).sqrt() as f32;
        let (mut flips, mut worst) = (0, (0.0, 0));
        for (i, (&g, &w)) in got.iter().zip(wanted).enumerate() {
            if !g.is_finite() {
                return Err(number(i));
            }
            let error = (g - w).abs() / (w.abs() + rms + 1e-20);
            flips += usize::from(error > self.tight);
            if error > worst.0 {
                worst = (error, i);
            }
        }
        let (error, i) = worst;
        if error > self.loose {
            return Err(number(i));
        }
        if flips > (self.flips * wanted.len() as f32).ceil() as usize {
            return Err(Mismatch::Share {
                what: what.into(),
                off: flips,
                length: wanted.len(),
                worst: error,
            });
        }
        Ok(())
    }
}
