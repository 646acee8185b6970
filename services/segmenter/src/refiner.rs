//! The interface of the 2D segmenter that refines masks on photos.

use segwild_scene::{Image, Mask};

/// Snaps rough masks to photos, several at a time.
pub trait Refiner: Sync {
    /// Refines a prior. `certainty` holds, per pixel of a reduced frame of the view, how likely the pixel belongs to the
    /// object (one plane in [0, 1]; about 0.5 where nothing is known). Returns a mask of any size and how far it is trusted,
    /// in [0, 1]; `None` when there is no answer.
    fn refine(&self, view: usize, certainty: &Image) -> Option<(Mask, f32)>;
    /// Whether the photo of a view can be refined at all: one that cannot is not selected where a scene has many.
    fn answers(&self, _view: usize) -> bool {
        true
    }
    /// Called on another thread when a view is likely to be refined soon, so that work can be done ahead. No answer
    /// may depend on it.
    fn prepare(&self, _view: usize) {}
    /// Called when a view that was prepared will not be refined soon after all: what was done ahead may be dropped.
    fn forget(&self, _view: usize) {}
}

impl<F: Fn(usize, &Image) -> Option<(Mask, f32)> + Sync> Refiner for F {
    fn refine(&self, view: usize, certainty: &Image) -> Option<(Mask, f32)> {
        self(view, certainty)
    }
}
