//! Splats that one photo alone shows (method, section 13).
//!
//! Nothing but that photo says how far from it such a splat is: seen from elsewhere, it is haze or a streak. Transients that a
//! training took for the scene are such splats, and so is the rim of what was photographed. They stay in the scene, and are left
//! out of objects that other photos show as well.

use crate::coverage::VOTE_FLOOR;

/// Vote `s_1` of a photo on a splat from which the photo shows it (method, section 13). By choice; not varied yet.
const MIN_SHOWN_VOTE: f32 = 0.1;

/// Share `s_2` of all votes on a splat that the other photos need to count as one more, where one photo shows it (method, section
/// 13). By choice; not varied yet.
const MIN_OTHER_SHARE: f32 = 0.1;

/// Share `q_1` of an object's splats, seen once, up to which they are left out of it (method, section 13): in a scene of two or
/// three photos nearly all may be. By choice; not varied yet.
const MAX_SEEN_ONCE: f32 = 0.25;

/// Counts, photo by photo, how many show each splat.
pub(crate) struct ShownCounter {
    /// Per splat, the photos whose vote is large enough.
    photos: Vec<u16>,
    /// Per splat, the sum of all votes, and the largest of them.
    votes: Vec<[f32; 2]>,
}

impl ShownCounter {
    /// Without photos yet.
    pub fn new(splats: usize) -> ShownCounter {
        ShownCounter { photos: vec![0; splats], votes: vec![[0.0; 2]; splats] }
    }

    /// Counts a photo: per splat the light in pixels that reaches it, and the light that would if nothing stood before it. `pixel`: the
    /// area of a pixel of the size that the scene is trained at, in pixels of the view that was rendered.
    pub fn add(&mut self, light: &[f32], unoccluded: &[f32], pixel: f32) {
        let floor = VOTE_FLOOR * pixel;
        let counts = self.photos.iter_mut().zip(&mut self.votes);
        for ((photos, [sum, most]), (&light, &whole)) in counts.zip(light.iter().zip(unoccluded)) {
            let vote = light / (whole.max(light) + floor);
            if vote > 0.0 {
                *photos = photos.saturating_add(u16::from(vote >= MIN_SHOWN_VOTE));
                (*sum, *most) = (*sum + vote, (*most).max(vote));
            }
        }
    }

    /// Per splat, the photos that show it: 1 where one photo alone does.
    pub fn counts(&self) -> Vec<u16> {
        let count = |(&photos, &[sum, most]): (&u16, &[f32; 2])| match photos {
            1 if sum - most >= MIN_OTHER_SHARE * sum => 2,
            photos => photos,
        };
        self.photos.iter().zip(&self.votes).map(count).collect()
    }
}

/// Whether so many splats of an object, seen once, are few enough of all of them to be left out.
fn are_few(once: usize, all: usize) -> bool {
    once as f32 <= MAX_SEEN_ONCE * all as f32
}

/// Leaves the splats that one photo alone shows out of a selection, and returns how many these are. `None` where so many of its
/// splats are seen once that the object is: it stays as it is.
pub(crate) fn leave_out(labels: &mut [bool], seen_once: &[bool]) -> Option<usize> {
    let all = labels.iter().filter(|label| **label).count();
    let once = labels.iter().zip(seen_once).filter(|(label, once)| **label && **once).count();
    are_few(once, all).then(|| {
        labels.iter_mut().zip(seen_once).for_each(|(label, once)| *label &= !once);
        once
    })
}

/// As [`leave_out`], for the parts of a scene: per splat the number of its part, 0 for none.
pub(crate) fn leave_out_of_parts(labels: &mut [u8], seen_once: &[bool]) {
    let mut counts = [[0usize; 2]; u8::MAX as usize + 1];
    for (&label, &once) in labels.iter().zip(seen_once) {
        counts[usize::from(label)][usize::from(once)] += 1;
    }
    for (label, _) in labels.iter_mut().zip(seen_once).filter(|(_, once)| **once) {
        let [others, once] = counts[usize::from(*label)];
        if are_few(once, once + others) {
            *label = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts of splats of 99 pixels, from the share of their light that reaches each photo.
    fn counts(photos: &[&[f32]]) -> Vec<u16> {
        let mut counter = ShownCounter::new(photos[0].len());
        for shares in photos {
            let light: Vec<f32> = shares.iter().map(|share| 99.0 * share).collect();
            counter.add(&light, &vec![99.0; shares.len()], 1.0);
        }
        counter.counts()
    }

    #[test]
    fn photos_that_show_a_splat_are_counted_and_a_little_of_it_in_many_is_one_more() {
        let photos: [&[f32]; 4] = [
            &[0.9, 0.9, 0.9, 0.0, 0.05],
            &[0.4, 0.0, 0.05, 0.0, 0.05],
            &[0.2, 0.01, 0.05, 0.0, 0.0],
            &[0.0, 0.0, 0.05, 0.0, 0.0],
        ];
        assert_eq!(counts(&photos), [3, 1, 2, 0, 0]);
        assert_eq!(counts(&photos[..1]), [1, 1, 1, 0, 0]);
    }

    #[test]
    fn far_from_it_a_photo_counts_as_much_as_near_to_it() {
        let mut counter = ShownCounter::new(1);
        counter.add(&[4000.0], &[5000.0], 1.0);
        counter.add(&[4.0], &[5.0], 1.0);
        assert_eq!(counter.counts(), [2]);
        // Of something smaller than a pixel a photo shows little.
        let mut counter = ShownCounter::new(1);
        counter.add(&[4000.0], &[5000.0], 1.0);
        counter.add(&[0.05], &[0.05], 1.0);
        assert_eq!(counter.counts(), [1]);
    }

    #[test]
    fn a_smaller_render_of_a_photo_counts_as_much() {
        let mut counter = ShownCounter::new(1);
        counter.add(&[4.0], &[5.0], 1.0);
        // A 50th of the pixels: without their area, the floor would hide it.
        counter.add(&[0.08], &[0.1], 0.02);
        assert_eq!(counter.counts(), [2]);
    }

    #[test]
    fn few_splats_seen_once_are_left_out() {
        let mut labels = [true, true, true, true, false, false];
        assert_eq!(leave_out(&mut labels, &[true, false, false, false, true, false]), Some(1));
        assert_eq!(labels, [false, true, true, true, false, false]);
    }

    #[test]
    fn an_object_that_is_seen_once_stays() {
        let mut labels = [true, true, true, false];
        assert_eq!(leave_out(&mut labels, &[true; 4]), None);
        assert_eq!(leave_out(&mut labels, &[true, false, false, false]), None, "a third");
        assert_eq!(labels, [true, true, true, false]);
    }

    #[test]
    fn each_part_of_a_scene_decides_for_itself() {
        let mut labels = [1, 1, 1, 1, 2, 2, 0];
        leave_out_of_parts(&mut labels, &[true, false, false, false, true, true, true]);
        assert_eq!(labels, [0, 1, 1, 1, 2, 2, 0]);
        leave_out_of_parts(&mut labels, &[]);
        assert_eq!(labels, [0, 1, 1, 1, 2, 2, 0], "nothing is known");
    }
}
