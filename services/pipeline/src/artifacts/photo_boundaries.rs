//! Boundaries of a run's photos, from which the scene tree is grown: a model's own, or the outlines of automatic masks (method,
//! section 13).

use crate::{RunError, RunFolder};
use segwild_flow::ledger::{State, ViewRow};
use segwild_flow::{Key, Ledger};
use segwild_scene::{Image, MaskSet, PhotoStore, Scene};
use segwild_segmenter::scene_tree::mask_outlines;
use segwild_vision::PromptSegmenter;
use std::collections::{BTreeMap, HashMap};

/// Domain of the masks' keys, kind of their records, and name of their stage in the ledger.
pub(crate) const MASKS: &str = "masks";

/// By view, the key of its masks; `None` where they were given up. Views of which no masks are made are left out.
pub(crate) type MaskKeys = BTreeMap<usize, Option<Key>>;

/// Reads the masks of a view; `None` where they have gone.
pub(crate) type MaskSetReader<'a> = dyn Fn(usize, &Key) -> Result<Option<MaskSet>, RunError> + 'a;

/// Where the boundaries of photos come from.
pub(crate) enum PhotoBoundaries<'a> {
    /// A model finds them.
    Model(&'a dyn PromptSegmenter),
    /// They are the outlines of the run's automatic masks.
    Masks {
        /// Which masks there are.
        keys: MaskKeys,
        /// Reads them.
        read: Box<MaskSetReader<'a>>,
    },
}

/// The boundaries of one photo.
pub(crate) enum PhotoCue {
    /// One plane of strengths in [0, 1].
    Strengths(Image),
    /// The photo takes no part.
    LeftOut,
    /// No masks are made of the photo: what it shows is only counted.
    OnlyCounted,
    /// They are needed, and are not there.
    Missing,
}

impl<'a> PhotoBoundaries<'a> {
    /// The boundaries of a finished run's photos: those of `segmenter`, or where it finds whole objects by itself the outlines of
    /// the masks that the run's cache has.
    ///
    /// # Errors
    /// When the ledger or the cache cannot be read.
    pub fn of_run(
        segmenter: &'a dyn PromptSegmenter,
        folder: &RunFolder,
        scene: &Scene,
    ) -> Result<PhotoBoundaries<'a>, RunError> {
        if !segmenter.finds_objects() {
            return Ok(PhotoBoundaries::Model(segmenter));
        }
        let cache = folder.cache()?;
        let ledger = Ledger::open_read_only(folder.ledger())?;
        // While masks are made there is no tree: one from some of them would not be the run's.
        let done = ledger.stages()?.iter().any(|stage| stage.name == MASKS && stage.state == State::Done);
        let keys = if done { recorded(&ledger.views(MASKS)?, scene) } else { MaskKeys::new() };
        let read = move |_: usize, key: &Key| -> Result<Option<MaskSet>, RunError> {
            Ok(cache.get_typed::<MaskSet>(key, MASKS)?)
        };
        Ok(PhotoBoundaries::Masks { keys, read: Box::new(read) })
    }

    /// Whether no photo takes part.
    pub fn is_empty(&self) -> bool {
        matches!(self, PhotoBoundaries::Masks { keys, .. } if keys.is_empty())
    }

    /// The boundaries of a view's photo at a `width` and `height` in pixels; photos and masks may have another size. Where masks were
    /// given up, the geometry alone has boundaries.
    ///
    /// # Errors
    /// When the model fails, or the masks cannot be read.
    pub fn of(
        &self,
        photos: &PhotoStore,
        view: usize,
        width: usize,
        height: usize,
    ) -> Result<PhotoCue, RunError> {
        match self {
            PhotoBoundaries::Model(segmenter) => {
                let Ok(photo) = photos.read(view) else { return Ok(PhotoCue::LeftOut) };
                let found = match (photo.image.width, photo.image.height) == (width, height) {
                    true => segmenter.boundary_strengths(&photo.image)?,
                    false => segmenter.boundary_strengths(&photo.image.resized(width, height))?,
                };
                Ok(found.map_or(PhotoCue::Missing, PhotoCue::Strengths))
            }
            PhotoBoundaries::Masks { keys, read } => {
                let key = match keys.get(&view) {
                    None => return Ok(PhotoCue::OnlyCounted),
                    Some(None) => return Ok(PhotoCue::Strengths(Image::zeros(width, height, 1))),
                    Some(Some(key)) => key,
                };
                let Some(masks) = read(view, key)? else {
                    let name = &photos.scene().views[view].name;
                    tracing::warn!(
                        "no scene tree is grown, since the masks of photo {name} have gone from the cache: `segwild run` makes them \
                         again"
                    );
                    return Ok(PhotoCue::Missing);
                };
                let outlines = mask_outlines(&masks);
                Ok(PhotoCue::Strengths(match (outlines.width, outlines.height) == (width, height) {
                    true => outlines,
                    false => outlines.resized(width, height),
                }))
            }
        }
    }
}

/// The masks of a scene's photos as the ledger has recorded them.
fn recorded(rows: &[ViewRow], scene: &Scene) -> MaskKeys {
    let of_row = |row: &ViewRow| match row.outcome.state {
        State::Done => Key::parse(MASKS, &row.key).map(Some),
        State::Failed => Some(None),
        State::Pending | State::Running => None,
    };
    let by_name: HashMap<&str, &ViewRow> = rows.iter().map(|row| (row.view.as_str(), row)).collect();
    let views = scene.views.iter().enumerate().filter(|(_, view)| !view.test);
    views.filter_map(|(i, view)| Some((i, of_row(by_name.get(view.name.as_str())?)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{Prompts, SceneSettings, ScoredMask};
    use segwild_synthetic::{SyntheticOptions, generate};
    use segwild_vision::{Prompted, VisionError};
    use std::sync::{Arc, Mutex};

    /// Keeps the sizes of the photos whose boundaries it finds.
    #[derive(Default)]
    struct SizeSegmenter(Mutex<Vec<(usize, usize)>>);

    impl PromptSegmenter for SizeSegmenter {
        fn key(&self) -> String {
            "sizes".into()
        }

        fn prompted(&self, _: &Image, _: &Prompts) -> Result<Prompted, VisionError> {
            unreachable!("boundaries alone are needed")
        }

        fn refine(&self, _: &Image, _: &Image) -> Result<ScoredMask, VisionError> {
            unreachable!("boundaries alone are needed")
        }

        fn finds_objects(&self) -> bool {
            false
        }

        fn boundary_strengths(&self, image: &Image) -> Result<Option<Image>, VisionError> {
            self.0.lock().expect("no test panics with it").push((image.width, image.height));
            Ok(Some(Image::zeros(image.width, image.height, 1)))
        }
    }

    #[test]
    fn boundaries_are_found_in_photos_at_the_size_of_the_tree() {
        let dir = tempfile::tempdir().expect("a folder");
        let options = SyntheticOptions { train: 4, test: 0, long_side: 64, ..SyntheticOptions::small() };
        generate(&options).and_then(|scene| scene.write(dir.path())).expect("a scene");
        let scene = Scene::open(dir.path(), &SceneSettings::default()).expect("a scene");
        let photos = PhotoStore::new(Arc::new(scene), 64, 1 << 20);
        let segmenter = SizeSegmenter::default();
        let boundaries = PhotoBoundaries::Model(&segmenter);
        let photo = photos.read(0).expect("a photo");
        let full = &photo.image;
        let small = (full.width / 2, full.height / 2);
        for (width, height) in [small, (full.width, full.height)] {
            let cue = boundaries.of(&photos, 0, width, height).expect("boundaries");
            assert!(matches!(cue, PhotoCue::Strengths(map) if (map.width, map.height) == (width, height)));
        }
        assert_eq!(*segmenter.0.lock().expect("no test panics with it"), [small, (full.width, full.height)]);
    }
}
