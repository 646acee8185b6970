//! What transients hide from a mask.
//!
//! A photo's mask ends where a transient stands before the object, and says nothing of what stands behind. At the foot of a place
//! that is in most photos: told as not the object's, plinths and steps went, and once gone were told to later photos as
//! background.

use crate::coverage::{clean, soft};
use segwild_scene::{Camera, Mask};

/// Share of its weight that a pixel outside of a mask loses to a transient there. Not all of it: of what is taken for transients
/// some is the scene in an odd light. All of it where what the transient hides surely resembles what was clicked.
const HIDDEN: f32 = 0.7;

/// How much each pixel of a frame says, in [0, 1], of which the mask covers `inside`. What the mask holds it has seen, whatever
/// was taken for a transient there. `resembling`: how surely what is rendered there resembles the clicks, in [0, 1]; `None`
/// where that is not known yet.
pub(crate) fn heard(
    inside: &[f32],
    transients: Option<&Mask>,
    resembling: Option<&[f32]>,
    frame: &Camera,
) -> Vec<f32> {
    let Some(transients) = transients else { return vec![1.0; inside.len()] };
    let mut heard = soft(transients, frame.width, frame.height);
    for (i, (heard, inside)) in heard.iter_mut().zip(inside).enumerate() {
        let sure = resembling.map_or(0.0, |r| clean(r[i]));
        *heard = 1.0 - (HIDDEN + (1.0 - HIDDEN) * sure) * *heard * (1.0 - inside);
    }
    heard
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The foot of a minaret that a bus hides, and the pavement under a shadow that was taken for a transient.
    #[test]
    fn what_a_transient_hides_says_nothing_where_it_resembles_the_clicks_and_little_elsewhere() {
        let frame = Camera { width: 4, height: 1, fx: 4.0, fy: 4.0, cx: 2.0, cy: 0.5 };
        let transients = Mask::from_fn(4, 1, |x, _| x > 0);
        let said =
            |resembling: Option<&[f32]>| heard(&[0.0, 0.0, 0.0, 1.0], Some(&transients), resembling, &frame);
        let close = |a: Vec<f32>, b: [f32; 4]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        let little = 1.0 - HIDDEN;
        assert!(close(said(None), [1.0, little, little, 1.0]));
        assert!(close(said(Some(&[1.0, 1.0, 0.0, 1.0])), [1.0, 0.0, little, 1.0]));
        assert!(close(said(Some(&[f32::NAN, f32::NAN, -1.0, 2.0])), [1.0, little, little, 1.0]));
        assert_eq!(heard(&[0.0, 1.0], None, Some(&[1.0, 1.0]), &frame), [1.0, 1.0]);
    }
}
