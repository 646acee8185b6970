//! An engine with splats held on its device.

use crate::engine::{Cloud, GpuEngine};
use segwild_raster::field::{DeviceLifting, DeviceRefinement, FeatureTarget, Queries, Refining};
use segwild_raster::{Channels, Engine, Held, Kept, ProjectOptions, Projected, RasterError, Resident, check};
use segwild_scene::{Camera, Pose, Splats};
use std::any::Any;
use std::sync::Arc;

/// The engine and the splats on its device.
pub(crate) struct HeldEngine<'s> {
    pub engine: &'s GpuEngine,
    pub splats: &'s Splats,
    pub cloud: Arc<Cloud>,
}

impl Engine for HeldEngine<'_> {
    fn name(&self) -> &'static str {
        self.engine.name()
    }

    fn project<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError> {
        // They are borrowed for as long as this lives: the same address holds the same splats.
        if !std::ptr::eq(splats, self.splats) {
            return self.engine.project(splats, camera, pose, options);
        }
        check(splats, camera)?;
        self.engine.project_cloud(splats, self.cloud.clone(), camera, pose, options)
    }

    fn bring(&self, channels: &Channels) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        self.engine.bring(channels)
    }

    fn settle_refining(&self, field: &Refining) -> Result<Option<Box<dyn DeviceRefinement>>, RasterError> {
        self.engine.settle_refining(field)
    }

    fn upload_target(
        &self,
        feature_target: &FeatureTarget,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        self.engine.upload_target(feature_target)
    }

    fn similarity(&self, features: &Kept, queries: &Queries) -> Result<Option<Vec<f32>>, RasterError> {
        self.engine.similarity(features, queries)
    }

    fn settle_lifting(
        &self,
        splats: usize,
        row: usize,
    ) -> Result<Option<Box<dyn DeviceLifting>>, RasterError> {
        self.engine.settle_lifting(splats, row)
    }

    fn settle(&self, held: &mut dyn FnMut() -> Held) -> Result<Option<Box<dyn Resident>>, RasterError> {
        self.engine.settle(held)
    }
}
