//! What an engine may do beside rasterising: train splats, and refine features, on its device. An engine that computes
//! on the host does neither by itself: the host's code of the trainer and of [`crate::field`] drives its rasteriser.

use crate::field::{DeviceLifting, DeviceRefinement, FeatureTarget, Lifting, Queries, Refining};
use crate::{Held, Resident};
use segwild_raster::{CpuEngine, Kept, RasterError, Rasterizer};
use std::any::Any;

/// Trains splats on its device.
pub trait TrainingBackend: Send + Sync {
    /// Uploads splats, which `held` provides, to be trained on the device. `None` where this engine computes on the
    /// host, or where they do not fit.
    fn settle(&self, _held: &mut dyn FnMut() -> Held) -> Result<Option<Box<dyn Resident>>, RasterError> {
        Ok(None)
    }
}

/// Lifts, refines and compares features on its device.
pub trait FieldBackend: Send + Sync {
    /// Allocates sums of rows of so many numbers per splat on the device, for
    /// [`Lifting::settle`]. `None` where this engine computes on the host, or where they
    /// would take too much memory.
    fn settle_lifting(
        &self,
        _splats: usize,
        _row: usize,
    ) -> Result<Option<Box<dyn DeviceLifting>>, RasterError> {
        Ok(None)
    }

    /// Uploads features, to be refined on the device ([`Refining::settle`]). `None` as for
    /// [`FieldBackend::settle_lifting`].
    fn settle_refining(&self, _field: &Refining) -> Result<Option<Box<dyn DeviceRefinement>>, RasterError> {
        Ok(None)
    }

    /// Uploads the feature target of a photo, for many steps ([`FeatureTarget::on_device`]). `None` as for
    /// [`FieldBackend::settle_lifting`].
    fn upload_target(
        &self,
        _feature_target: &FeatureTarget,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        Ok(None)
    }

    /// [`score`](crate::field::score) of features that were uploaded; `None` where they were not.
    fn similarity(&self, _features: &Kept, _queries: &Queries) -> Result<Option<Vec<f32>>, RasterError> {
        Ok(None)
    }
}

impl Lifting {
    /// Moves them to the device of an engine, if it has the memory.
    pub fn settle(&mut self, engine: &dyn FieldBackend) -> Result<(), RasterError> {
        self.on_device = engine.settle_lifting(self.splats(), self.row())?;
        Ok(())
    }
}

impl Refining {
    /// Moves them to the device of an engine, if it has the memory.
    pub fn settle(&mut self, engine: &dyn FieldBackend) -> Result<(), RasterError> {
        self.on_device = engine.settle_refining(self)?;
        Ok(())
    }
}

/// All that the trainer and the feature field need of one device.
pub trait Engine: Rasterizer + TrainingBackend + FieldBackend {}

impl<T: Rasterizer + TrainingBackend + FieldBackend> Engine for T {}

impl TrainingBackend for CpuEngine {}

impl FieldBackend for CpuEngine {}
