//! Whether transparent photos are cut-outs of an object.
//!
//! Where passers-by are painted transparent, most of a photo's border stays opaque. Where objects are cut out, they lie in the
//! middle, with another outline in each photo. A transparent frame that is the same in each photo (a round lens, borders that
//! undistortion left empty) holds no information about the scene.

use crate::photo::cheap_ones;
use crate::{Alpha, Mask, SceneError, SceneSettings, View};
use rayon::prelude::*;

/// Photos checked, evenly over the names.
const LOOKED_AT: usize = 5;
/// Long side in pixels at which they are checked.
const SIZE: u32 = 160;
/// Least share of the border, and of the photo, that is transparent in a cut-out.
const BORDER: f64 = 0.6;
const AREA: f64 = 0.2;
/// Outlines that overlap by more than this are one frame.
const SAME: f64 = 0.97;

/// Decides for the photos that can be transparent (those whose `reading.empty` is set) whether transparent means empty, and sets
/// `reading.empty`. Returns a note for the user where one is due.
pub(crate) fn decide(views: &mut [View], settings: &SceneSettings) -> Option<String> {
    let with_alpha = views.iter().filter(|view| view.photo.reading.empty).count();
    let open = settings.alpha == Alpha::Auto && 2 * with_alpha > views.len();
    let looked_at = if open { to_look_at(views) } else { Vec::new() };
    let too_large = open && looked_at.is_empty() && views.iter().any(can_be_cut_out);
    let empty = match settings.alpha {
        Alpha::Ignore => false,
        Alpha::Empty => true,
        Alpha::Auto => are_cut_outs(&looked_at),
    };
    for view in views.iter_mut() {
        view.photo.reading.empty &= empty;
    }
    if too_large {
        return Some(format!(
            "{with_alpha} of {} photos can be transparent, and are too large to see in time whether they are cut-outs: what is \
             transparent in them is taken as not known (--alpha empty: as empty)",
            views.len()
        ));
    }
    (empty && settings.alpha == Alpha::Auto).then(|| {
        format!(
            "{with_alpha} of {} photos are cut-outs: what is transparent in them is taken as empty (--alpha ignore: as not known)",
            views.len()
        )
    })
}

fn can_be_cut_out(view: &View) -> bool {
    view.photo.reading.empty && view.photo.lens.is_none()
}

/// A few that can be cut-outs and take little memory, evenly over the names.
fn to_look_at(views: &[View]) -> Vec<&View> {
    let transparent: Vec<&View> = views.iter().filter(|view| can_be_cut_out(view)).collect();
    let with_bytes = transparent.into_par_iter().map(|view| (view, view.decoding_bytes(SIZE)));
    let cheap = cheap_ones(with_bytes.collect(), LOOKED_AT);
    let every = cheap.len().div_ceil(LOOKED_AT).max(1);
    cheap.into_iter().step_by(every).collect()
}

fn are_cut_outs(looked_at: &[&View]) -> bool {
    let opaque = |view: &&View| -> Result<Mask, SceneError> {
        // The scene is still being opened: there is no store of its photos yet, and later none at this size.
        let loaded = view.load(SIZE)?;
        let all = || Mask::full(loaded.camera.width, loaded.camera.height);
        Ok(loaded.empty.map_or_else(all, |empty| empty.not()))
    };
    let outlines: Vec<Mask> = looked_at.iter().filter_map(|view| opaque(view).ok()).collect();
    let cut_out = outlines.iter().filter(|outline| is_cut_out(outline)).count();
    2 * cut_out > outlines.len() && !is_one_frame(&outlines)
}

/// Whether most of the border is transparent: one object, or several.
fn is_cut_out(opaque: &Mask) -> bool {
    let (w, h) = (opaque.width(), opaque.height());
    let border: Vec<bool> = (0..w)
        .flat_map(|x| [opaque.get(x, 0), opaque.get(x, h - 1)])
        .chain((0..h).flat_map(|y| [opaque.get(0, y), opaque.get(w - 1, y)]))
        .collect();
    let bare = border.iter().filter(|&&there| !there).count() as f64 / border.len() as f64;
    let area = 1.0 - opaque.count() as f64 / f64::from(w * h);
    bare >= BORDER && area >= AREA && !opaque.is_empty()
}

/// Whether all outlines are one.
fn is_one_frame(outlines: &[Mask]) -> bool {
    let same = |pair: &[Mask]| {
        let (a, b) = (&pair[0], &pair[1]);
        (a.width(), a.height()) == (b.width(), b.height()) && a.iou(b) > SAME
    };
    outlines.len() > 1 && outlines.windows(2).all(same)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cut_outs_of_several_objects_are_cut_outs_and_photos_with_holes_are_none() {
        let in_box = |x: u32, y: u32, at: u32| (at..at + 12).contains(&x) && (10..30).contains(&y);
        let objects = Mask::from_fn(60, 40, |x, y| in_box(x, y, 8) || in_box(x, y, 24) || in_box(x, y, 40));
        assert!(is_cut_out(&objects));
        // Passers-by were painted out.
        assert!(!is_cut_out(&objects.not()));
        assert!(!is_cut_out(&Mask::full(60, 40)) && !is_cut_out(&Mask::empty(60, 40)));
    }
}
