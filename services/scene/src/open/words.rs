//! What to say of a scene that was opened.

use crate::draft::{Draft, DraftPhoto, DraftPoint};
use crate::split::{Split, SplitPart};
use crate::{HoldOut, SceneError, SceneSettings, Skipped, View};
use std::collections::HashSet;

/// What to say of photos that are read from a converted copy: the first, and how many more there are.
pub(super) fn copies(copied: Vec<String>) -> Option<String> {
    match copied.len() {
        0 => None,
        1 => copied.into_iter().next(),
        n => copied.first().map(|first| format!("{first}, and {} more photos from theirs", n - 1)),
    }
}

/// What is odd about a reconstruction, though it can be used.
pub(super) fn notes(draft: &Draft, views: usize, points: usize, view_of: &[Option<u32>]) -> Vec<String> {
    let mut notes = draft.notes.clone();
    let (source, all) = (draft.source.display(), draft.points.len());
    let count = |odd: &dyn Fn(&DraftPoint) -> bool| draft.points.iter().filter(|p| odd(p)).count();
    let broken = count(&|p| !p.position.is_finite());
    if broken > 0 {
        notes.push(format!(
            "{source}: {broken} of {all} points lie nowhere (a position is no number) and are left out"
        ));
    }
    let lost = count(&|p| !p.track.is_empty() && p.track.iter().all(|(photo, _)| view_of[*photo].is_none()));
    if lost > 0 {
        notes.push(format!(
            "{source}: {lost} of {all} points were seen by unusable photos alone and are left out"
        ));
    }
    let unseen = count(&|p| p.track.is_empty());
    // nerfstudio's points never say who saw them.
    if unseen > 0 && (unseen < all || draft.source.extension().is_none_or(|e| e != "json")) {
        notes.push(format!(
            "{source}: {unseen} of {all} points name no photo that sees them: they start splats, but do not help to find any \
             photo's light or transients"
        ));
    }
    if points == 0 {
        notes.push(format!("{source}: there are no points: the training starts from random splats"));
    }
    if views == 1 {
        notes.push(
            "there is one photo: nothing tells how far away things are, so only views close to it will look right".into(),
        );
    }
    notes
}

/// Which split is taken, and how many photos it gives to what.
pub(super) fn split_in_words(
    split: &Split,
    views: &[View],
    draft: &Draft,
    settings: &SceneSettings,
) -> String {
    let tests = views.iter().filter(|view| view.test).count();
    let of =
        |photo: &&DraftPhoto| matches!(split.part(&photo.name), Some(SplitPart::Train | SplitPart::Test));
    let left = draft.photos.len() - draft.photos.iter().filter(of).count();
    let who = if matches!(settings.hold_out, HoldOut::Every(_)) { ", as `hold_out` says" } else { "" };
    format!(
        "the split {} is taken: {} photos train, {tests} are held out for testing{who}, {left} are left out; `--split none` takes none",
        split.path.display(),
        views.len() - tests
    )
}

/// How many photos are held out, where nothing says which.
pub(super) fn held_out_in_words(views: &[View]) -> Option<String> {
    let held_out = views.iter().filter(|view| view.test).count();
    (held_out > 0).then(|| {
        format!(
            "{held_out} of {} photos are held out of the training, to be scored; `--hold-out none` trains on all",
            views.len()
        )
    })
}

/// The error of a scene none of whose photos can be used.
pub(super) fn nothing_usable(draft: &Draft, skipped: &[Skipped]) -> SceneError {
    let names: HashSet<&str> = draft.photos.iter().map(|p| p.name.as_str()).collect();
    let of_draft = |s: &&Skipped| names.contains(s.name.as_str());
    let reason = match (skipped.iter().find(of_draft), draft.photos.len()) {
        (Some(first), 1) => format!("its only photo, {}, cannot be used: {}", first.name, first.reason),
        (Some(first), n) => {
            format!("of {n} photos none can be used; the first, {}: {}", first.name, first.reason)
        }
        (None, _) => "the reconstruction has no photo".to_owned(),
    };
    SceneError::NothingUsable { path: draft.source.clone(), reason }
}
