//! What objects change of the splats, for the page's own rasteriser: cut shapes, and colours of their own appearances.

use super::state::{Studio, StudioError};
use crate::document::{KeptObject, Objects};
use segwild_flow::Stopper;
use segwild_pipeline::ShownParts;

impl Studio {
    /// What the present state changes of [`Studio::packed`] ([`segwild_pipeline::Session::packed_changes`]), and its version, which
    /// is the state's unless splats of an object are lost.
    ///
    /// # Errors
    /// When an appearance is gone, or `stopper` stops it.
    pub fn packed_changes(&self, stopper: &Stopper) -> Result<(Vec<u8>, String), StudioError> {
        let mut state = self.state();
        let objects = state.document.objects().clone();
        let found: Vec<_> = objects
            .all
            .iter()
            .filter_map(|object| Some((object, state.store.get(&object.selection)?)))
            .collect();
        drop(state);
        let mut parts = ShownParts::default();
        for (object, selected) in &found {
            if objects.cuts(object) {
                parts.cut.push(selected);
            }
            if let Some(own) = &object.appearance {
                parts.appearances.push((&selected.labels, own));
            }
        }
        let version = version_of(&objects, |object| found.iter().any(|(there, _)| there.id == object.id));
        Ok((self.session.packed_changes(&parts, stopper)?, version))
    }
}

/// Names what those objects change of the splats whose splats are there; empty where they change nothing.
pub(super) fn version_of(objects: &Objects, there: impl Fn(&KeptObject) -> bool) -> String {
    let mut text = String::new();
    for object in objects.all.iter().filter(|object| there(object)) {
        let hash = &object.selection.hash;
        if objects.cuts(object) {
            text += &format!("cut {hash}\n");
        }
        if let Some(own) = &object.appearance {
            text += &format!("appearance {hash} {own:?}\n");
        }
    }
    if text.is_empty() { text } else { blake3::hash(text.as_bytes()).to_hex()[..16].to_owned() }
}
