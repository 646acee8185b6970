//! An engine with a fallback engine: a lost device does not end a run.

use crate::field::Queries;
use crate::{Engine, FieldBackend, TrainingBackend};
use segwild_raster::{
    Channels, Frame, FrameGrad, ProjectOptions, Projected, RasterError, Rasterizer, ResidentChannels,
    SplatGrads,
};
use segwild_scene::{Camera, Image, Pose, Splats};
use std::any::Any;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

/// Computes with one engine until its device fails, and with another from then on. Other errors of the first engine are
/// returned.
pub struct FallbackEngine<F> {
    first: Box<dyn Engine>,
    second: Box<dyn Engine>,
    failed: AtomicBool,
    on_failure: F,
}

impl<F: Fn(&str) + Send + Sync> FallbackEngine<F> {
    /// `on_failure` is called once with the reason why the first engine failed.
    pub fn new(first: Box<dyn Engine>, second: Box<dyn Engine>, on_failure: F) -> FallbackEngine<F> {
        FallbackEngine { first, second, failed: AtomicBool::new(false), on_failure }
    }

    fn has_failed(&self) -> bool {
        self.failed.load(Ordering::Acquire)
    }

    /// Result of the first engine; that of the second once the device of the first has failed.
    fn either<T>(
        &self,
        first: impl FnOnce() -> Result<T, RasterError>,
        second: impl FnOnce() -> Result<T, RasterError>,
    ) -> Result<T, RasterError> {
        if self.has_failed() {
            return second();
        }
        match first() {
            Err(RasterError::Device(why)) => {
                if !self.failed.swap(true, Ordering::AcqRel) {
                    (self.on_failure)(&why);
                }
                second()
            }
            done => done,
        }
    }
}

impl<F: Fn(&str) + Send + Sync> Rasterizer for FallbackEngine<F> {
    /// The first engine's, even after a failure: the artefacts of a run keep their names.
    fn name(&self) -> &'static str {
        self.first.name()
    }

    fn kept_bytes(&self) -> usize {
        self.first.kept_bytes() + self.second.kept_bytes()
    }

    fn project<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError> {
        self.either(
            || {
                let first = self.first.project(splats, camera, pose, options)?;
                let (camera, pose, options) = (*camera, *pose, *options);
                let second = OnceLock::new();
                let view = FallbackView { engine: self, splats, camera, pose, options, first, second };
                Ok(Box::new(view) as Box<dyn Projected + 'a>)
            },
            || self.second.project(splats, camera, pose, options),
        )
    }

    fn keeps_channels(&self, splats: usize, count: usize) -> bool {
        let engine = if self.has_failed() { &self.second } else { &self.first };
        engine.keeps_channels(splats, count)
    }

    fn upload_channels(
        &self,
        channels: &Channels,
    ) -> Result<Option<Box<dyn Any + Send + Sync>>, RasterError> {
        self.either(|| self.first.upload_channels(channels), || self.second.upload_channels(channels))
    }
}

impl<F: Fn(&str) + Send + Sync> TrainingBackend for FallbackEngine<F> {}

impl<F: Fn(&str) + Send + Sync> FieldBackend for FallbackEngine<F> {
    fn similarity(
        &self,
        features: &(dyn Any + Send + Sync),
        queries: &Queries,
    ) -> Result<Option<Vec<f32>>, RasterError> {
        self.either(|| self.first.similarity(features, queries), || self.second.similarity(features, queries))
    }
}

/// A view that the first engine projected, and the second one too if it has to.
struct FallbackView<'a, F> {
    engine: &'a FallbackEngine<F>,
    splats: &'a Splats,
    camera: Camera,
    pose: Pose,
    options: ProjectOptions,
    first: Box<dyn Projected + 'a>,
    second: OnceLock<Box<dyn Projected + 'a>>,
}

impl<'a, F: Fn(&str) + Send + Sync> FallbackView<'a, F> {
    fn second(&self) -> Result<&dyn Projected, RasterError> {
        if let Some(second) = self.second.get() {
            return Ok(&**second);
        }
        let made = self.engine.second.project(self.splats, &self.camera, &self.pose, &self.options)?;
        Ok(&**self.second.get_or_init(|| made))
    }
}

impl<F: Fn(&str) + Send + Sync> Projected for FallbackView<'_, F> {
    fn depths(&self) -> &[f32] {
        self.first.depths()
    }

    fn radii(&self) -> &[f32] {
        self.first.radii()
    }

    fn centres(&self) -> &[[f32; 2]] {
        self.first.centres()
    }

    fn shade(&self) -> Vec<f32> {
        self.first.shade()
    }

    fn blend(&self, channels: &Channels) -> Result<Frame, RasterError> {
        self.engine.either(|| self.first.blend(channels), || self.second()?.blend(channels))
    }

    fn blend_resident(&self, channels: &ResidentChannels) -> Result<Frame, RasterError> {
        // The second engine cannot use the first engine's copy: it takes the host's.
        self.engine.either(|| self.first.blend_resident(channels), || self.second()?.blend_resident(channels))
    }

    fn gather(&self, image: &Image) -> Result<Vec<f32>, RasterError> {
        self.engine.either(|| self.first.gather(image), || self.second()?.gather(image))
    }

    fn backward(
        &self,
        channels: &Channels,
        frame: &Frame,
        grad: &FrameGrad,
    ) -> Result<SplatGrads, RasterError> {
        self.engine.either(
            || self.first.backward(channels, frame, grad),
            || self.second()?.backward(channels, frame, grad),
        )
    }

    fn shade_backward(&self, colours: &[f32], grads: &mut SplatGrads) -> Vec<f32> {
        self.first.shade_backward(colours, grads)
    }
}
