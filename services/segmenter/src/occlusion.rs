//! Occlusion of the object by transients.
//!
//! A photo's mask ends where a transient occludes the object, and holds no evidence about what is occluded. At the foot of a
//! building that is so in most photos. Counted as evidence against, plinths and steps were lost, and later photos then got
//! them as background in their prior.

use crate::coverage::{clean, soft};
use segwild_scene::{Camera, Mask};

/// Share `o` of its weight that a pixel outside of a mask loses to a transient there (method, section 6.1). Not all of it: some
/// of a transient mask is the scene in unusual light. All of it where the occluded splats surely resemble the clicks. From
/// docs/experiments/2026-11-25-occluded-parts.md. IoU by half, half more: +.011, -.021 on `sacre_coeur`; -.010, +.004 on the
/// demo.
const TRANSIENT_DISCOUNT: f32 = 0.7;

/// Weight of each pixel of a frame as evidence, in [0, 1]; the mask covers `inside` of it. Pixels inside the mask keep their
/// weight, whatever the transient mask holds there. `resembling`: how surely the splats rendered there resemble the clicks,
/// in [0, 1]; `None` where that is not known yet.
pub(crate) fn pixel_visibility(
    inside: &[f32],
    transients: Option<&Mask>,
    resembling: Option<&[f32]>,
    frame: &Camera,
) -> Vec<f32> {
    let Some(transients) = transients else { return vec![1.0; inside.len()] };
    let mut pixel_visibility = soft(transients, frame.width, frame.height);
    for (i, (pixel_visibility, inside)) in pixel_visibility.iter_mut().zip(inside).enumerate() {
        let sure = resembling.map_or(0.0, |r| clean(r[i]));
        *pixel_visibility = 1.0
            - (TRANSIENT_DISCOUNT + (1.0 - TRANSIENT_DISCOUNT) * sure) * *pixel_visibility * (1.0 - inside);
    }
    pixel_visibility
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The foot of a minaret that a bus occludes, and the pavement under a shadow in the transient mask.
    #[test]
    fn an_occluded_pixel_has_no_weight_where_it_resembles_the_clicks_and_little_elsewhere() {
        let frame = Camera { width: 4, height: 1, fx: 4.0, fy: 4.0, cx: 2.0, cy: 0.5 };
        let transients = Mask::from_fn(4, 1, |x, _| x > 0);
        let with_resemblance = |resembling: Option<&[f32]>| {
            pixel_visibility(&[0.0, 0.0, 0.0, 1.0], Some(&transients), resembling, &frame)
        };
        let close = |a: Vec<f32>, b: [f32; 4]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        let little = 1.0 - TRANSIENT_DISCOUNT;
        assert!(close(with_resemblance(None), [1.0, little, little, 1.0]));
        assert!(close(with_resemblance(Some(&[1.0, 1.0, 0.0, 1.0])), [1.0, 0.0, little, 1.0]));
        assert!(close(with_resemblance(Some(&[f32::NAN, f32::NAN, -1.0, 2.0])), [1.0, little, little, 1.0]));
        assert_eq!(pixel_visibility(&[0.0, 1.0], None, Some(&[1.0, 1.0]), &frame), [1.0, 1.0]);
    }
}
