//! The objects of a session's scene: their list and their export.

use super::resident::Session;
use crate::output::objects::write_objects;
use crate::{
    ExportFormat, ExportedObjects, ListedObjects, ObjectList, ObjectProvenance, Replay, RunError, SceneObject,
};
use segwild_flow::Stopper;
use segwild_flow::files::Obstacle;
use std::path::Path;

impl ObjectList {
    /// Whether it lists the objects of a session's scene: it may be of an earlier training.
    pub fn is_of(&self, session: &Session) -> bool {
        session.list_request().is_ok_and(|request| request.key == self.tree)
    }
}

/// Writes all objects of a run's list into the folder `out`, as a whole or not at all: a file of each in `format`, `labels.ply` (the whole scene;
/// the property `object` is the number, 0 for none), `labels.npy` (the same numbers alone, in its order), `coco.json` (their masks on all photos, as taken), `objects.json` and
/// `sheet.png`. Colours have the appearance of the photo `appearance`, or the scene's own if it is empty. Spikes are not
/// cut: [`Session::ask`] refines one object.
///
/// # Errors
/// When the run has no scene tree, `appearance` is no photo, the folder is not empty, the format's program is missing or fails,
/// a file cannot be written, or `stopper` stops it.
pub fn export_objects(
    session: &Session,
    listed: &ListedObjects,
    out: &Path,
    appearance: &str,
    format: ExportFormat,
    stopper: &Stopper,
) -> Result<ExportedObjects, RunError> {
    let objects = listed.list.objects.iter().map(|object| selected(listed, object));
    let provenance = session.provenance(objects.collect());
    write_objects(&session.list_request()?, listed, provenance, out, appearance, format, stopper)
}

/// How an object of a list is selected.
fn selected(listed: &ListedObjects, object: &SceneObject) -> ObjectProvenance {
    let query = listed.list.query(&object.number.to_string()).ok();
    let replay = query.map(|query| Replay { object: Some(query), ..Replay::default() });
    ObjectProvenance { name: object.label(), replay, edited: false }
}

/// Lists the objects of a run and writes the list, for [`ObjectList::read`]. Names of the list before are kept. A folder that can only
/// be read is no obstacle: [`ListedObjects::not_kept`] says so.
///
/// # Errors
/// When the run has no scene tree, a file cannot be written for another reason, or `stopper` stops it.
pub fn list_objects(session: &Session, stopper: &Stopper) -> Result<ListedObjects, RunError> {
    let folder = session.folder();
    let before = ObjectList::read(folder);
    let mut listed = session.list_request()?.list(before.as_ref(), stopper)?;
    match listed.write(folder) {
        Err(RunError::File(error)) if matches!(error.obstacle, Obstacle::Denied | Obstacle::ReadOnly) => {
            let is_there = before.as_ref() == Some(&listed.list);
            listed.not_kept = (!is_there).then(|| error.to_string());
        }
        written => written?,
    }
    Ok(listed)
}
