//! Masks of objects on all photos, as an archive that is made while it is sent.

use super::archive_turn::CountedBytes;
use super::export::file_stem;
use super::state::{LOST, REPLACED, Studio, StudioError};
use crate::document::{KeptObject, ObjectId, StoredSelection};
use crate::zip::{self, ArchiveIsFull, MOST_FILES, ZipWriter};
use segwild_flow::Stopper;
use segwild_pipeline::MaskedObject;
use std::collections::VecDeque;
use std::sync::{Arc, Weak};

/// Photos whose masks make a part.
const PHOTOS: usize = 8;

/// The archive would be too large.
const FULL: StudioError = StudioError::Request(zip::FULL);

/// An object whose masks are being written.
struct PresentObject {
    /// Its folder in the archive, with a `/`; empty where it is the only one.
    folder: String,
    object: MaskedObject,
    /// Photos that are done.
    photos: usize,
    _bytes: CountedBytes,
}

/// The masks of objects, as PNGs of the size of the photos as taken, with `provenance.json` beside them. Only one object and a few
/// photos are in memory.
pub(crate) struct MaskArchive {
    /// A session is not held by a client that takes its time.
    studio: Weak<Studio>,
    stopper: Stopper,
    /// `None` after the end.
    zip: Option<ZipWriter>,
    provenance: Option<Vec<u8>>,
    /// Folders of the objects that are to come, and their splats.
    objects: VecDeque<(String, StoredSelection)>,
    /// Whether it is of all objects: those whose splats are lost are left out.
    of_all: bool,
    present: Option<PresentObject>,
}

impl Studio {
    /// The archive of the masks of an object, or of all kept ones, and the file's name.
    ///
    /// # Errors
    /// When there is no such object, its splats are lost, or there would be too many files.
    pub(crate) fn mask_archive(
        self: &Arc<Self>,
        id: Option<ObjectId>,
        stopper: Stopper,
    ) -> Result<(String, MaskArchive), StudioError> {
        let kept: Vec<KeptObject> = {
            let mut state = self.state();
            match id {
                Some(id) => {
                    let object = state.document.objects().get(id)?.clone();
                    state.store.get(&object.selection).ok_or(LOST)?;
                    vec![object]
                }
                None => state.document.objects().all.clone(),
            }
        };
        if kept.len().saturating_mul(2 * self.session.scene().views.len()) >= MOST_FILES {
            return Err(FULL);
        }
        let provenance = serde_json::to_vec_pretty(&self.provenance_of(&kept));
        let provenance =
            provenance.map_err(|_| StudioError::Request("the settings of this run cannot be written"))?;
        let name = id
            .and(kept.first())
            .map_or("masks.zip".into(), |object| format!("{}.masks.zip", file_stem(&object.name)));
        let folder = |object: &KeptObject| match id {
            Some(_) => String::new(),
            None => format!("{}-{}/", object.id, file_stem(&object.name)),
        };
        let archive = MaskArchive {
            studio: Arc::downgrade(self),
            stopper,
            zip: Some(ZipWriter::default()),
            provenance: Some(provenance),
            objects: kept.iter().map(|object| (folder(object), object.selection.clone())).collect(),
            of_all: id.is_none(),
            present: None,
        };
        Ok((name, archive))
    }

    /// The turn to make an archive.
    pub(crate) fn archive_turn(&self) -> Arc<tokio::sync::Mutex<()>> {
        self.archives.turn()
    }
}

impl MaskArchive {
    /// The next part; `None` after the last one, and after an error.
    ///
    /// # Errors
    /// When the scene cannot be rendered or was replaced, the archive becomes too large, or its stopper stops it.
    pub fn next_part(&mut self) -> Result<Option<Vec<u8>>, StudioError> {
        let part = self.make_part();
        if part.is_err() {
            self.zip = None;
            self.present = None;
        }
        part
    }

    fn make_part(&mut self) -> Result<Option<Vec<u8>>, StudioError> {
        let full = |_: ArchiveIsFull| FULL;
        let Some(zip) = &mut self.zip else { return Ok(None) };
        if let Some(text) = self.provenance.take() {
            return Ok(Some(zip.file("provenance.json", &text).map_err(full)?));
        }
        let studio = self.studio.upgrade().ok_or(REPLACED)?;
        let session = &studio.session;
        while self.present.is_none() {
            let Some((folder, selection)) = self.objects.pop_front() else { break };
            let selected = studio.state().store.get(&selection);
            let Some(selected) = selected else {
                // Of many objects the others are there.
                if self.of_all {
                    continue;
                }
                return Err(LOST);
            };
            let object = session.masked_object(&selected);
            let bytes = studio.archives.count(object.bytes());
            self.present = Some(PresentObject { folder, object, photos: 0, _bytes: bytes });
        }
        let Some(PresentObject { folder, object, photos, .. }) = &mut self.present else {
            let end = self.zip.take().map(ZipWriter::end).transpose();
            return end.map_err(full);
        };
        let (first, all) = (*photos, session.scene().views.len());
        *photos = all.min(first + PHOTOS);
        let files = session.mask_files(object, first..*photos, &self.stopper)?;
        let mut part = Vec::new();
        for (name, [visible, amodal]) in session.image_names()[first..*photos].iter().zip(files) {
            part.extend(zip.file(&format!("{folder}masks/{name}"), &visible).map_err(full)?);
            part.extend(zip.file(&format!("{folder}amodal/{name}"), &amodal).map_err(full)?);
        }
        if *photos == all {
            self.present = None;
        }
        Ok(Some(part))
    }
}
