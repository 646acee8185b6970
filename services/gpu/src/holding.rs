//! An engine with splats held on its device.

use crate::engine::{Cloud, GpuEngine};
use segwild_raster::{Channels, ProjectOptions, Projected, RasterError, Rasterizer, check};
use segwild_scene::{Camera, Pose, Splats};
use std::any::Any;
use std::sync::Arc;

/// The engine and the splats on its device.
pub(crate) struct HeldEngine<'s> {
    pub engine: &'s GpuEngine,
    pub splats: &'s Splats,
    pub cloud: Arc<Cloud>,
}

impl Rasterizer for HeldEngine<'_> {
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
}
