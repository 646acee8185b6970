//! What an engine may do beside rasterising: train splats, and refine features, on its device. An engine that computes
//! on the host does neither by itself: the host's code of the trainer and of [`crate::field`] drives its rasteriser.

use crate::field::{DeviceLifting, DeviceRefinement, FeatureTarget, FieldRefinement, Lifting, Queries};
use crate::{DeviceTraining, TrainingSplats};
use segwild_raster::{CpuEngine, RasterError, Rasterizer};
use std::any::Any;

/// Trains splats on its device.
pub trait TrainingBackend: Send + Sync {
    /// Uploads splats, which `splats` provides, to be trained on the device. `None` where this engine computes on the
    /// host, or where they do not fit.
    fn upload_training(
        &self,
        _splats: &mut dyn FnMut() -> TrainingSplats,
    ) -> Result<Option<Box<dyn DeviceTraining>>, RasterError> {
        Ok(None)
    }
}

/// Lifts, refines and compares features on its device.
pub trait FieldBackend: Send + Sync {
    /// Allocates sums of rows of so many numbers per splat on the device, for [`Lifting::allocate_on_device`]. `None`
    /// where this engine computes on the host, or where they would take too much memory.
    fn allocate_lifting(
        &self,
        _splats: usize,
        _row: usize,
    ) -> Result<Option<Box<dyn DeviceLifting>>, RasterError> {
        Ok(None)
    }

    /// Uploads features, to be refined on the device ([`FieldRefinement::upload`]). `None` as for
    /// [`FieldBackend::allocate_lifting`].
    fn upload_refinement(
        &self,
        _field: &FieldRefinement,
    ) -> Result<Option<Box<dyn DeviceRefinement>>, RasterError> {
        Ok(None)
    }

    /// Uploads the feature target of a photo, for many steps ([`FeatureTarget::on_device`]). `None` as for
    /// [`FieldBackend::allocate_lifting`].
    fn upload_target(
        &self,
        _feature_target: &FeatureTarget,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        Ok(None)
    }

    /// [`score`](crate::field::score) of the features that [`Rasterizer::upload_channels`] returned; `None` where they are on
    /// another device.
    fn similarity(
        &self,
        _features: &(dyn Any + Send + Sync),
        _queries: &Queries,
    ) -> Result<Option<Vec<f32>>, RasterError> {
        Ok(None)
    }
}

impl Lifting {
    /// Allocates the sums on the device of an engine, if it has the memory; before the first view.
    pub fn allocate_on_device(&mut self, engine: &dyn FieldBackend) -> Result<(), RasterError> {
        self.on_device = engine.allocate_lifting(self.splats(), self.row())?;
        Ok(())
    }
}

impl FieldRefinement {
    /// Uploads the features to the device of an engine, if it has the memory.
    pub fn upload(&mut self, engine: &dyn FieldBackend) -> Result<(), RasterError> {
        self.on_device = engine.upload_refinement(self)?;
        Ok(())
    }
}

/// All that the trainer and the feature field need of one device.
pub trait Engine: Rasterizer + TrainingBackend + FieldBackend {}

impl<T: Rasterizer + TrainingBackend + FieldBackend> Engine for T {}

impl TrainingBackend for CpuEngine {}

impl FieldBackend for CpuEngine {}
