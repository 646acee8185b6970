//! Objects as files.

use super::state::{LOST, Studio, StudioError, mark};
use crate::document::{KeptObject, ObjectId};
use segwild_flow::{FileError, Stopper};
use segwild_pipeline::{ExportProvenance, ObjectList, ObjectProvenance, Selected};
use segwild_scene::SplatFormat;
use std::sync::Arc;

impl Studio {
    pub(super) fn selection_of(&self, id: ObjectId) -> Result<Arc<Selected>, StudioError> {
        let mut state = self.state();
        let selection = state.document.objects().get(id)?.selection.clone();
        state.store.get(&selection).ok_or(LOST)
    }

    /// An object as a file, and the file's name. It has its own appearance where it has one, and the scene's otherwise.
    ///
    /// # Errors
    /// When there is no such object, or its splats are lost.
    pub fn object_file(&self, id: ObjectId, format: SplatFormat) -> Result<(String, Vec<u8>), StudioError> {
        let selected = self.selection_of(id)?;
        let (object, scene) = {
            let state = self.state();
            let objects = state.document.objects();
            (objects.get(id)?.clone(), objects.appearance.clone())
        };
        let provenance = self.provenance_of(std::slice::from_ref(&object));
        let appearance = object.appearance.unwrap_or(scene);
        let name = format!("{}.{format}", file_stem(&object.name));
        Ok((name, self.session.object_file(&selected, &appearance, format, &provenance)?))
    }

    /// The prompts of an object as a file, and the file's name: `segwild segment --prompts` selects the object by it.
    ///
    /// # Errors
    /// When there is no such object, or tools made or changed it.
    pub fn prompts_file(&self, id: ObjectId) -> Result<(String, Vec<u8>), StudioError> {
        let object = self.state().document.objects().get(id)?.clone();
        if object.draft.is_empty() || object.edited {
            return Err(StudioError::Request(
                "a tool made or changed this object: no prompts select its splats",
            ));
        }
        let text = serde_json::to_vec_pretty(&self.replay(&object.draft));
        let text = text.map_err(|_| StudioError::Request("the prompts of this object cannot be written"))?;
        Ok((format!("{}.prompts.json", file_stem(&object.name)), text))
    }

    /// An object, or the kept objects, and per splat of the scene the number of its object from 1, 0 for none.
    ///
    /// # Errors
    /// When there is no such object.
    pub(super) fn numbered(&self, id: Option<ObjectId>) -> Result<(Vec<KeptObject>, Vec<u8>), StudioError> {
        let mut state = self.state();
        let objects = state.document.objects();
        let all = match id {
            Some(id) => vec![objects.get(id)?.clone()],
            None => objects.all.clone(),
        };
        let mut labels = vec![0u8; self.session.model().splats.len()];
        for (object, number) in all.iter().zip(1..) {
            match state.store.get(&object.selection) {
                Some(selected) => mark(&mut labels, &selected.labels, number),
                None if id.is_none() => {}
                None => return Err(LOST),
            }
        }
        Ok((all, labels))
    }

    /// How files of these objects are made.
    pub(super) fn provenance_of(&self, objects: &[KeptObject]) -> ExportProvenance {
        let of = |object: &KeptObject| ObjectProvenance {
            name: object.name.clone(),
            replay: (!object.draft.is_empty()).then(|| self.replay(&object.draft)),
            edited: object.edited,
        };
        self.session.provenance(objects.iter().map(of).collect())
    }

    /// The whole scene as a `.ply` whose property `object` numbers the kept objects.
    ///
    /// # Errors
    /// When an appearance is gone.
    pub fn labelled_ply(&self) -> Result<Vec<u8>, StudioError> {
        let appearance = self.state().document.objects().appearance.clone();
        Ok(self.session.labelled_ply(&self.numbered(None)?.1, &appearance)?)
    }

    /// The masks of an object, or of all kept ones, on all photos, as a COCO file, and the file's name.
    ///
    /// # Errors
    /// When there is no such object, its splats are lost, the scene cannot be rendered, or `stopper` stops it.
    pub fn coco(&self, id: Option<ObjectId>, stopper: &Stopper) -> Result<(String, Vec<u8>), StudioError> {
        let (objects, labels) = self.numbered(id)?;
        let name = id
            .and(objects.first())
            .map_or("coco.json".into(), |object| format!("{}.coco.json", file_stem(&object.name)));
        Ok((name, self.session.coco_masks(self.provenance_of(&objects), labels, stopper)?))
    }

    /// The sheet of the listed objects' thumbnails, as PNG.
    ///
    /// # Errors
    /// When there is none.
    pub fn sheet(&self) -> Result<Vec<u8>, StudioError> {
        let path = ObjectList::sheet(self.session.folder());
        Ok(segwild_flow::files::read_plain(&path).map_err(|e| FileError::new("read", &path, e))?)
    }
}

/// An object's name as that of a file or a selection: other signs than letters, digits, dashes and dots become underscores.
pub(super) fn file_stem(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    name.chars().map(plain).collect()
}
