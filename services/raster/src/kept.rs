//! Channels that are blended in many views.

use crate::{Channels, RasterError, Rasterizer};
use std::any::Any;
use std::borrow::Cow;

/// Channels that stay on the device of an engine, to be blended in view after view by
/// [`Projected::blend_kept`](crate::Projected::blend_kept). The numbers on the host cannot change meanwhile, so the
/// device's copy cannot be out of date. An engine without a copy of its own uses the host's numbers.
pub struct Kept<'a> {
    count: usize,
    values: Cow<'a, [f32]>,
    on_device: Option<Box<dyn Any + Send + Sync>>,
}

impl<'a> Kept<'a> {
    /// `count` numbers per splat, as in [`Channels`], not uploaded yet.
    pub fn new(count: usize, values: impl Into<Cow<'a, [f32]>>) -> Kept<'a> {
        Kept { count, values: values.into(), on_device: None }
    }

    /// Uploads them to the device of an engine, if it has one.
    pub fn bring(&mut self, engine: &dyn Rasterizer) -> Result<(), RasterError> {
        self.on_device = engine.bring(&self.channels())?;
        Ok(())
    }

    /// The channels.
    pub fn channels(&self) -> Channels<'_> {
        Channels { count: self.count, values: &self.values }
    }

    /// Handle that [`Rasterizer::bring`] returned.
    pub fn on_device(&self) -> Option<&(dyn Any + Send + Sync)> {
        self.on_device.as_deref()
    }
}
