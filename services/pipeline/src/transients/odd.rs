//! What is odd about the transients of a photo, and of all photos.

use super::authorship::FOLDER;
use segwild_scene::Mask;

/// Largest share of a photo that may be transient when the photo is compared with the trained scene.
pub(super) const MOST: f32 = 0.6;

/// PSNR in dB under which a photo does not fit the scene. If hardly any of it is transient, the reason is another one.
const MISFIT: f32 = 12.0;

/// What is odd about a photo's mask, in a sentence: nearly all of the photo is transient, or hardly any of a photo that
/// does not fit the scene at all.
pub(super) fn odd(photo: &str, image: &str, mask: &Mask, psnr: f32) -> Option<String> {
    let share = share_of(mask);
    let percent = 100.0 * share;
    if share > MOST {
        return Some(format!(
            "photo {photo}: {percent:.0} % of it contradicts the scene; correct {FOLDER}/{image}, or leave the photo out"
        ));
    }
    (psnr < MISFIT && share < 0.05).then(|| {
        format!(
            "photo {photo} does not fit the scene ({psnr:.1} dB), and only {percent:.0} % of it is found to be transient: its \
             pose may be wrong, or its light beyond what the appearance model fits; paint its transients into {FOLDER}/{image}, or \
             leave it out"
        )
    })
}

/// Share of a photo that its mask covers, 0 to 1.
pub(super) fn share_of(mask: &Mask) -> f32 {
    mask.count() as f32 / (f64::from(mask.width()) * f64::from(mask.height())).max(1.0) as f32
}

/// A photo of which more than this share contradicts the scene is crowded. Fewer transients are found than there are:
/// where transients truly cover 25 % about 20 % is found, and hardly more however much they cover.
const CROWDED: f32 = 0.2;
/// A run warns when more than this share of its photos is crowded.
const MANY: f32 = 0.34;

/// The warning when many photos contradict the scene. `shares` has the transient share of each photo.
pub(super) fn crowded(shares: &[f32]) -> Option<String> {
    let many = shares.iter().filter(|s| **s > CROWDED).count();
    (shares.len() > 2 && many as f32 > MANY * shares.len() as f32).then(|| {
        format!(
            "in {many} of {} photos more than {:.0} % contradicts the scene: transients in most of them, light beyond what the \
             appearance model fits, or poses that do not fit",
            shares.len(),
            100.0 * CROWDED
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_of_everything_and_one_of_nothing_are_named() {
        let words = |mask: &Mask, psnr| odd("a.jpg", "a.png", mask, psnr);
        let all = words(&Mask::full(40, 30), 20.0).expect("all of it");
        assert!(all.contains("a.jpg") && all.contains("100 %") && all.contains("transients/a.png"), "{all}");
        let none = words(&Mask::empty(40, 30), 9.0).expect("nothing, and it does not fit");
        assert!(none.contains("a.jpg") && none.contains("9.0 dB"), "{none}");
        assert!(words(&Mask::empty(40, 30), 25.0).is_none(), "it fits, and shows no transient");
        assert!(words(&Mask::from_fn(40, 30, |x, _| x < 8), 9.0).is_none(), "transients explain it");
    }
}
