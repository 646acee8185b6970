//! How each photo's colours differ from the scene's: fits for the affine rung (method, section 3).

use crate::background::solve;
use crate::{LookKind, TrainSettings};
use segwild_raster::{AffineLook, AnyLook, NoLook};

/// A colour matrix with offset, row-major 3 x 4: `c' = M (c, 1)`.
pub(crate) type Affine = [f32; 12];

/// The look that changes nothing.
pub(crate) const IDENTITY: Affine = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// Looks for `views` photos, and one more, at index `views`: the mean look, in which the scene is shown when
/// no photo is named.
pub(crate) fn begin(settings: &TrainSettings, views: usize) -> AnyLook {
    match settings.look {
        LookKind::None => AnyLook::None(NoLook),
        LookKind::Affine => {
            let mut look = AffineLook::new(views + 1);
            look.rate = settings.lr_look;
            AnyLook::Affine(look)
        }
    }
}

/// A view's matrix; the identity for looks that have none.
pub(crate) fn matrix(look: &AnyLook, view: usize) -> Affine {
    match look {
        AnyLook::None(_) => IDENTITY,
        AnyLook::Affine(affine) => affine.matrix(view),
    }
}

/// The look that maps scene colours (premultiplied, with their alpha) to photo colours, by least squares
/// that prefers the identity; entries are (scene colour, alpha, photo colour, weight). Twice refitted with
/// less weight on what does not fit, so that a stranger in the photo does not tint it.
pub(crate) fn fit(pairs: impl Iterator<Item = ([f32; 3], f32, [f32; 3], f32)> + Clone) -> Affine {
    let mut look = IDENTITY;
    for round in 0..3 {
        let mut ata = [[0.0f64; 4]; 4];
        let mut atb = [[0.0f64; 3]; 4];
        let mut total = 0.0;
        for (colour, alpha, photo, weight) in pairs.clone() {
            let x = [colour[0], colour[1], colour[2], alpha];
            let off = (0..3).map(|r| (dot(&look, r, &x) - photo[r]).abs()).sum::<f32>() / 3.0;
            // Cauchy weights once there is something to compare with.
            let w = f64::from(if round == 0 { weight } else { weight / (1.0 + (off / 0.08).powi(2)) });
            if !w.is_finite() || w == 0.0 {
                continue;
            }
            total += w;
            for i in 0..4 {
                for j in 0..4 {
                    ata[i][j] += w * f64::from(x[i]) * f64::from(x[j]);
                }
                for r in 0..3 {
                    atb[i][r] += w * f64::from(x[i]) * f64::from(photo[r]);
                }
            }
        }
        // Without data the identity; the offset is freer than the matrix.
        let ridge = 2e-3 * total + 0.05;
        for i in 0..4 {
            ata[i][i] += ridge;
            for r in 0..3 {
                atb[i][r] += ridge * f64::from(IDENTITY[4 * r + i]);
            }
        }
        let solution = solve(ata, atb);
        for r in 0..3 {
            for i in 0..4 {
                look[4 * r + i] = solution[i][r] as f32;
            }
        }
    }
    look
}

fn dot(look: &Affine, row: usize, x: &[f32; 4]) -> f32 {
    (0..4).map(|k| look[4 * row + k] * x[k]).sum()
}

/// The mean of several looks; the identity when there is none.
pub(crate) fn mean<'a>(of: impl IntoIterator<Item = &'a Affine>) -> Affine {
    let (mut sum, mut n) = ([0.0f32; 12], 0);
    for look in of {
        n += 1;
        for (s, v) in sum.iter_mut().zip(look) {
            *s += v;
        }
    }
    if n == 0 { IDENTITY } else { sum.map(|s| s / n as f32) }
}

/// The colours that a look turns into `colour`; the least-squares ones nearest to `colour` where the look
/// loses some.
pub(crate) fn undo(look: &Affine, colours: &[[f32; 3]]) -> Vec<[f32; 3]> {
    const RIDGE: f64 = 1e-3;
    let m = |r: usize, c: usize| f64::from(look[4 * r + c]);
    let mut ata = [[0.0f64; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            ata[i][j] = (0..3).map(|r| m(r, i) * m(r, j)).sum::<f64>();
        }
        ata[i][i] += RIDGE;
    }
    colours
        .iter()
        .enumerate()
        .map(|(k, colour)| {
            // Only the constant part of a background carries the offset.
            let offset = |r: usize| if k == 0 { m(r, 3) } else { 0.0 };
            let seen: [f64; 3] = std::array::from_fn(|r| f64::from(colour[r]) - offset(r));
            let mut atb = [[0.0f64; 1]; 3];
            for i in 0..3 {
                atb[i][0] = (0..3).map(|r| m(r, i) * seen[r]).sum::<f64>() + RIDGE * f64::from(colour[i]);
            }
            solve(ata, atb).map(|row| row[0] as f32)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Random;

    const LOOK: Affine = [0.8, 0.1, 0.0, 0.05, 0.0, 1.1, -0.1, 0.0, 0.1, 0.0, 0.6, 0.2];

    #[test]
    fn a_look_is_found_despite_strangers_and_can_be_undone() {
        let mut r = Random::new(3);
        let pairs: Vec<([f32; 3], f32, [f32; 3], f32)> = (0..600)
            .map(|i| {
                let c = [r.uniform(), r.uniform(), r.uniform()];
                let x = [c[0], c[1], c[2], 1.0];
                let seen = [0, 1, 2].map(|k| dot(&LOOK, k, &x));
                (c, 1.0, if i % 7 == 0 { [0.9, 0.0, 0.0] } else { seen }, 1.0)
            })
            .collect();
        let found = fit(pairs.iter().copied());
        for k in 0..12 {
            assert!((found[k] - LOOK[k]).abs() < 0.05, "{k}: {} {}", found[k], LOOK[k]);
        }
        let shown = [[0.3, 0.4, 0.5], [0.1, 0.0, -0.2]];
        let back = undo(&LOOK, &shown);
        for k in 0..2 {
            let x = [back[k][0], back[k][1], back[k][2], if k == 0 { 1.0 } else { 0.0 }];
            assert!((0..3).all(|c| (dot(&LOOK, c, &x) - shown[k][c]).abs() < 0.01));
        }
        // Nothing known: nothing changed. A look that shows everything grey can be undone to something finite.
        assert_eq!(fit(std::iter::empty()), IDENTITY);
        assert!(undo(&[0.0; 12], &shown).iter().flatten().all(|v| v.is_finite()));
    }
}
