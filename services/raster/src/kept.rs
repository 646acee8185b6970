//! Channels that many views are asked for.

use crate::{Channels, Engine, RasterError};
use std::any::Any;
use std::borrow::Cow;

/// Channels that stay where an engine computes, to be blended into view after view by
/// [`Projected::blend_kept`](crate::Projected::blend_kept). The numbers here cannot change as long as they are kept, so the
/// engine's copy cannot be out of date; and where it is another engine's, or there is none, these are taken.
pub struct Kept<'a> {
    count: usize,
    values: Cow<'a, [f32]>,
    on_device: Option<Box<dyn Any + Send + Sync>>,
}

impl<'a> Kept<'a> {
    /// `count` numbers per splat, as in [`Channels`], which no engine has yet.
    pub fn new(count: usize, values: impl Into<Cow<'a, [f32]>>) -> Kept<'a> {
        Kept { count, values: values.into(), on_device: None }
    }

    /// Brings them to where this engine computes, if it keeps any.
    pub fn bring(&mut self, engine: &dyn Engine) -> Result<(), RasterError> {
        self.on_device = engine.bring(&self.channels())?;
        Ok(())
    }

    /// The channels.
    pub fn channels(&self) -> Channels<'_> {
        Channels { count: self.count, values: &self.values }
    }

    /// What [`Engine::bring`] gave.
    pub fn on_device(&self) -> Option<&(dyn Any + Send + Sync)> {
        self.on_device.as_deref()
    }
}
