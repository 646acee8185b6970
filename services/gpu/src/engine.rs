//! The engine: what it does of the traits of raster and objective, on its device.

use crate::GpuError;
use crate::adapter::{Adapter, AdapterChoice};
use crate::bin::{Cloud, bin};
use crate::channels::GpuChannels;
use crate::compare::GpuPhotoCache;
use crate::device::GpuDevice;
use crate::field::{GpuFeatureTarget, GpuField, GpuSums};
use crate::memory::field_fits;
use crate::parameters::GpuTraining;
use crate::shaders::Kernel;
use crate::view::GpuProjected;
use crate::work_counts::WorkCounts;
use segwild_objective::field::{DeviceLifting, DeviceRefinement, FeatureTarget, FieldRefinement, Queries};
use segwild_objective::{DeviceTraining, TrainingSplats};
use segwild_objective::{FieldBackend, TrainingBackend};
use segwild_raster::{Channels, ProjectOptions, Projected, RasterError, Rasterizer, check};
use segwild_scene::{Camera, Pose, Splats};
use std::any::Any;
use std::sync::Arc;

/// The rasteriser for accelerators. Make one and keep it: kernels are compiled on first use, and its memory is used
/// again from view to view.
pub struct GpuEngine {
    pub(crate) device: Arc<GpuDevice>,
    pub(crate) photos_on_device: Arc<GpuPhotoCache>,
}

impl GpuEngine {
    /// Opens an accelerator.
    pub fn new(choice: &AdapterChoice) -> Result<GpuEngine, GpuError> {
        GpuEngine::with_edit(choice, true, |_, text| text)
    }

    /// The same without subgroups, whether or not the accelerator has some.
    pub fn without_subgroups(choice: &AdapterChoice) -> Result<GpuEngine, GpuError> {
        GpuEngine::with_edit(choice, false, |_, text| text)
    }

    /// The same with edited kernels: tests plant faults so.
    #[doc(hidden)]
    pub fn with_edit(
        choice: &AdapterChoice,
        subgroups: bool,
        edit: impl Fn(&Kernel, String) -> String + Send + Sync + 'static,
    ) -> Result<GpuEngine, GpuError> {
        let device = Arc::new(GpuDevice::open(choice, subgroups, Box::new(edit))?);
        tracing::info!(adapter = device.adapter.name, backend = device.adapter.backend, "accelerator opened");
        Ok(GpuEngine { device, photos_on_device: Arc::default() })
    }

    /// Takes so many bytes of the accelerator's memory at the most from now on; 0 sets no limit.
    pub fn keep_within(&self, bytes: u64) {
        self.device.keep_within(bytes);
    }

    /// How many may be taken; 0 sets no limit.
    pub fn budget(&self) -> u64 {
        self.device.budget()
    }

    /// Bytes of the accelerator's memory that are taken.
    pub fn allocated_bytes(&self) -> u64 {
        self.device.allocated_bytes()
    }

    /// What the accelerator was given to do since it was opened.
    pub fn work_counts(&self) -> WorkCounts {
        self.device.work_counts()
    }

    /// The accelerator in use.
    pub fn adapter(&self) -> &Adapter {
        &self.device.adapter
    }
}

impl Rasterizer for GpuEngine {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn project<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError> {
        check(splats, camera)?;
        let cloud = Arc::new(Cloud::upload(&mut self.device.work(), splats)?);
        self.project_cloud(splats, cloud, camera, pose, options)
    }

    fn upload_splats<'a>(
        &'a self,
        splats: &'a Splats,
    ) -> Result<Option<Box<dyn Rasterizer + 'a>>, RasterError> {
        let cloud = if_it_fits(Cloud::upload(&mut self.device.work(), splats))?.map(Arc::new);
        Ok(cloud.map(|cloud| {
            Box::new(ResidentSplats { engine: self, splats, cloud }) as Box<dyn Rasterizer + 'a>
        }))
    }

    fn keeps_channels(&self, splats: usize, count: usize) -> bool {
        GpuChannels::fit(splats, count, self.budget())
    }

    fn upload_channels(
        &self,
        channels: &Channels,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        let resident = if_it_fits(GpuChannels::upload(&self.device, channels))?.flatten();
        Ok(resident.map(|resident| Box::new(resident) as Box<dyn Any + Send + Sync>))
    }
}

impl FieldBackend for GpuEngine {
    fn upload_refinement(
        &self,
        field: &FieldRefinement,
    ) -> Result<Option<Box<dyn DeviceRefinement>>, RasterError> {
        if !field_fits(GpuField::bytes(field), self.budget()) {
            return Ok(None);
        }
        let field = if_it_fits(GpuField::upload(&self.device, field))?;
        Ok(field.map(|field| Box::new(field) as Box<dyn DeviceRefinement>))
    }

    fn upload_target(
        &self,
        feature_target: &FeatureTarget,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        let uploaded =
            if_it_fits(GpuFeatureTarget::upload_for_many_steps(&self.device, feature_target))?.flatten();
        Ok(uploaded.map(|uploaded| Box::new(uploaded) as Box<dyn Any + Send + Sync>))
    }

    fn similarity(
        &self,
        features: &(dyn Any + Send + Sync),
        queries: &Queries,
    ) -> Result<Option<Vec<f32>>, RasterError> {
        let resident = features.downcast_ref::<GpuChannels>();
        match resident.filter(|resident| resident.is_on(&self.device)) {
            Some(resident) => if_it_fits(resident.similarity(queries)),
            None => Ok(None),
        }
    }

    fn allocate_lifting(
        &self,
        splats: usize,
        row: usize,
    ) -> Result<Option<Box<dyn DeviceLifting>>, RasterError> {
        if !field_fits(GpuSums::bytes(splats, row), self.budget()) {
            return Ok(None);
        }
        let sums = if_it_fits(GpuSums::new(&self.device, splats, row))?;
        Ok(sums.map(|sums| Box::new(sums) as Box<dyn DeviceLifting>))
    }
}

impl TrainingBackend for GpuEngine {
    fn upload_training(
        &self,
        splats: &mut dyn FnMut() -> TrainingSplats,
    ) -> Result<Option<Box<dyn DeviceTraining>>, RasterError> {
        match GpuTraining::upload(&self.device, &self.photos_on_device, &splats()) {
            Ok(training) => Ok(Some(Box::new(training))),
            Err(error) if error.is_out_of_memory() => {
                tracing::warn!("splats stay on the host while they are trained: {error}");
                Ok(None)
            }
            Err(error) => Err(error.into()),
        }
    }
}

/// The engine and the splats on its device.
pub(crate) struct ResidentSplats<'s> {
    pub engine: &'s GpuEngine,
    pub splats: &'s Splats,
    pub cloud: Arc<Cloud>,
}

impl Rasterizer for ResidentSplats<'_> {
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

    fn keeps_channels(&self, splats: usize, count: usize) -> bool {
        self.engine.keeps_channels(splats, count)
    }

    fn upload_channels(
        &self,
        channels: &Channels,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        self.engine.upload_channels(channels)
    }
}

/// A result of the device; `None` where it is out of memory.
fn if_it_fits<T>(made: Result<T, GpuError>) -> Result<Option<T>, RasterError> {
    match made {
        Ok(made) => Ok(Some(made)),
        Err(error) if error.is_out_of_memory() => Ok(None),
        Err(error) => Err(error.into()),
    }
}

impl GpuEngine {
    pub(crate) fn project_cloud<'a>(
        &'a self,
        splats: &'a Splats,
        cloud: Arc<Cloud>,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError> {
        let mut work = self.device.work();
        let (binned, seen) = bin(&mut work, cloud, camera, pose, options, None)?;
        let seen = work.read(&seen, splats.len())?;
        drop(work);
        let eye = pose.centre();
        let size = [camera.width as usize, camera.height as usize];
        Ok(Box::new(GpuProjected::new(&self.device, splats, eye, size, binned, &seen)))
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn an_array_that_cannot_be_bound_is_refused_with_its_size() {
        let test = "an_array_that_cannot_be_bound_is_refused_with_its_size";
        let Some(engine) = crate::test_adapter::engine(test) else { return };
        let most = engine.adapter().binding as usize;
        let error = engine.device.work().take::<u8>("the image", most + 16).err().expect("it is too long");
        let text = error.to_string();
        assert!(text.contains("the image") && text.contains(&(most + 16).to_string()), "{text}");
        assert!(text.contains(&most.to_string()) && text.contains(&engine.adapter().name), "{text}");
    }
}
