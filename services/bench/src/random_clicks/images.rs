//! Images of answers: the true masks beside what was selected.

use super::answers::{TrueObject, failed, selected_in};
use crate::contact_sheet::contact_sheet;
use crate::page::{PageError, io};
use segwild_pipeline::{PhotoPrompts, Session, Settings};
use segwild_scene::{Image, Mask};
use std::path::Path;

/// Photos on the image: the prompted one, and those on which the answer is worst.
const PHOTOS: usize = 6;
/// Colours of true masks and of answers, linear.
const TRUTH: [f32; 3] = [0.1, 0.8, 0.2];
const ANSWER: [f32; 3] = [1.0, 0.35, 0.0];
/// How much of the colour lies over the pixels of a mask; its outline is opaque.
const COVER: f32 = 0.4;

impl TrueObject<'_> {
    /// Selects by one prompt once more, and draws the answer beside the true masks.
    pub fn draw(
        &self,
        session: &Session,
        settings: &Settings,
        prompts: PhotoPrompts,
        file: &Path,
    ) -> Result<(), PageError> {
        let prompted = prompts.photo.clone();
        let answer = self.answer(session, settings, &[prompts], 0)?;
        let iou =
            |photo: &str| answer.photos.iter().find(|(name, _)| name == photo).map_or(0.0, |(_, iou)| *iou);
        let mut photos: Vec<&(String, Mask)> = self.shown.iter().collect();
        photos.sort_by(|(a, _), (b, _)| {
            (b == &prompted).cmp(&(a == &prompted)).then(iou(a).total_cmp(&iou(b)))
        });
        let mut pairs = Vec::new();
        for (name, truth) in photos.into_iter().take(PHOTOS) {
            let Some(view) = session.scene().view_named(name) else { continue };
            let photo = session.photo(view, session.size()).map_err(failed)?;
            let as_shown = |mask: Mask| {
                let mask = session.scene().views[view].mask_from_taken(mask);
                mask.resized(photo.width as u32, photo.height as u32)
            };
            let selected = selected_in(session, &answer, name)?
                .unwrap_or_else(|| Mask::empty(truth.width(), truth.height()));
            let [truth, selected] = [truth.clone(), selected].map(as_shown);
            pairs.push([covered(&photo, &truth, TRUTH), covered(&photo, &selected, ANSWER)]);
        }
        let pairs: Vec<[&Image; 2]> = pairs.iter().map(|[truth, selected]| [truth, selected]).collect();
        if pairs.is_empty() {
            return Ok(());
        }
        io(file, contact_sheet(&pairs).write_png(file).map_err(std::io::Error::other))
    }
}

/// A photo with a mask of its size in a colour over it.
fn covered(photo: &Image, mask: &Mask, colour: [f32; 3]) -> Image {
    let outline = mask.boundary(1);
    let mut covered = photo.clone();
    for (c, value) in colour.into_iter().enumerate().take(photo.channels) {
        for (i, pixel) in covered.plane_mut(c).iter_mut().enumerate() {
            let share = match (outline.index(i), mask.index(i)) {
                (true, _) => 1.0,
                (false, true) => COVER,
                (false, false) => 0.0,
            };
            *pixel += share * (value - *pixel);
        }
    }
    covered
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_is_seen_through_and_its_outline_is_not() {
        let photo = Image::filled(8, 8, 3, 0.5);
        let mask = Mask::from_fn(8, 8, |x, y| (2..7).contains(&x) && (2..7).contains(&y));
        let shown = covered(&photo, &mask, ANSWER);
        assert_eq!(shown.at(0, 0, 0), 0.5);
        assert_eq!(shown.at(0, 2, 2), 1.0);
        assert!((shown.at(0, 4, 4) - (0.5 + COVER * 0.5)).abs() < 1e-6);
    }
}
