//! Whether transparent photos are cut-outs of an object.
//!
//! A person who paints passers-by transparent leaves a photo whose border is mostly there; who cuts an object out leaves one piece
//! in the middle, of another outline in each photo. Frames that are the same in each photo (a round lens, borders that were bent
//! out) say nothing of the scene.

use crate::{Alpha, Mask, SceneError, SceneSettings, View};

/// Photos looked at, evenly over the names.
const LOOKED_AT: usize = 5;
/// Long side at which they are.
const SIZE: u32 = 160;
/// Least share of the border, and of the photo, that is transparent in a cut-out.
const BORDER: f64 = 0.6;
const AREA: f64 = 0.2;
/// Least share of what is opaque that is one piece.
const PIECE: f64 = 0.8;
/// Outlines that overlap by more than this are one frame.
const SAME: f64 = 0.97;

/// Decides for each photo that can be transparent (`reading.empty` is set of those) what that means; what to say of it.
pub(crate) fn decide(views: &mut [View], settings: &SceneSettings) -> Option<String> {
    let with_alpha = views.iter().filter(|view| view.photo.reading.empty).count();
    let empty = match settings.alpha {
        Alpha::Ignore => false,
        Alpha::Empty => true,
        Alpha::Auto => 2 * with_alpha > views.len() && are_cut_outs(views),
    };
    for view in views.iter_mut() {
        view.photo.reading.empty &= empty;
    }
    (empty && settings.alpha == Alpha::Auto).then(|| {
        format!(
            "{with_alpha} of {} photos are cut-outs: what is transparent in them is taken as empty (--alpha ignore: as not known)",
            views.len()
        )
    })
}

fn are_cut_outs(views: &[View]) -> bool {
    let transparent: Vec<&View> =
        views.iter().filter(|v| v.photo.reading.empty && v.photo.lens.is_none()).collect();
    let every = transparent.len().div_ceil(LOOKED_AT).max(1);
    let opaque = |view: &&View| -> Result<Mask, SceneError> {
        let loaded = view.load(SIZE)?;
        let all = || Mask::full(loaded.camera.width, loaded.camera.height);
        Ok(loaded.empty.map_or_else(all, |empty| empty.not()))
    };
    let outlines: Vec<Mask> =
        transparent.iter().step_by(every).filter_map(|view| opaque(view).ok()).collect();
    let cut_out = outlines.iter().filter(|outline| is_cut_out(outline)).count();
    2 * cut_out > outlines.len() && !is_one_frame(&outlines)
}

/// Whether what is opaque is one piece that the border mostly is no part of.
fn is_cut_out(opaque: &Mask) -> bool {
    let (w, h) = (opaque.width(), opaque.height());
    let border: Vec<bool> = (0..w)
        .flat_map(|x| [opaque.get(x, 0), opaque.get(x, h - 1)])
        .chain((0..h).flat_map(|y| [opaque.get(0, y), opaque.get(w - 1, y)]))
        .collect();
    let bare = border.iter().filter(|&&there| !there).count() as f64 / border.len() as f64;
    let area = 1.0 - opaque.count() as f64 / f64::from(w * h);
    let (labels, count) = opaque.components();
    let mut sizes = vec![0usize; count + 1];
    labels.iter().filter(|&&label| label > 0).for_each(|&label| sizes[label as usize] += 1);
    let largest = sizes.into_iter().max().unwrap_or(0) as f64;
    bare >= BORDER && area >= AREA && largest >= PIECE * opaque.count() as f64 && largest > 0.0
}

/// Whether all outlines are one.
fn is_one_frame(outlines: &[Mask]) -> bool {
    let same = |pair: &[Mask]| {
        let (a, b) = (&pair[0], &pair[1]);
        (a.width(), a.height()) == (b.width(), b.height()) && a.iou(b) > SAME
    };
    outlines.len() > 1 && outlines.windows(2).all(same)
}
