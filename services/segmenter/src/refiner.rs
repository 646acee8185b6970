//! What the segmenter asks of whoever sees in photos.

use segwild_scene::{Image, Mask};

/// Snaps rough masks to photos, several at a time.
pub trait Refiner: Sync {
    /// Is given the view's index and, per pixel of a reduced frame, how likely the pixel belongs to the object (one plane in
    /// [0, 1]; about 0.5 where nothing is known). It answers with a mask of any size and how much it trusts it, in [0, 1];
    /// `None` when it cannot tell.
    fn refine(&self, view: usize, certainty: &Image) -> Option<(Mask, f32)>;
    /// Hears, on another thread, that a view is likely to be asked about soon: what can be worked out before may be. No answer
    /// may depend on it.
    fn prepare(&self, _view: usize) {}
}

impl<F: Fn(usize, &Image) -> Option<(Mask, f32)> + Sync> Refiner for F {
    fn refine(&self, view: usize, certainty: &Image) -> Option<(Mask, f32)> {
        self(view, certainty)
    }
}
