//! What strangers hide from a mask.
//!
//! A photo's mask ends where a stranger stands before the object, and says nothing of what stands behind. At the foot of a place
//! that is in most photos: told as not the object's, plinths and steps went, and once gone were told to later photos as
//! background.

use crate::coverage::soft;
use segwild_scene::{Camera, Mask};

/// Share of its weight that a pixel outside of a mask loses to a stranger there. Not all of it: of what is taken for strangers
/// some is the scene in an odd light.
const HIDDEN: f32 = 0.7;

/// How much each pixel of a frame says, in [0, 1], of which the mask covers `inside`. What the mask holds it has seen, whatever
/// was taken for a stranger there.
pub(crate) fn heard(inside: &[f32], strangers: Option<&Mask>, frame: &Camera) -> Vec<f32> {
    let Some(strangers) = strangers else { return vec![1.0; inside.len()] };
    let hidden = soft(strangers, frame.width, frame.height);
    inside.iter().zip(&hidden).map(|(inside, hidden)| 1.0 - HIDDEN * hidden * (1.0 - inside)).collect()
}
