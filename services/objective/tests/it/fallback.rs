//! A device that is lost during a run.

use crate::common::{RasterTestRandom, splats, view};
use segwild_objective::{Engine, FallbackEngine, FieldBackend, TrainingBackend};
use segwild_raster::{
    Channels, CpuEngine, Frame, FrameGrad, ProjectOptions, Projected, RasterError, Rasterizer, SplatGrads,
};
use segwild_scene::{Camera, Image, Pose, Splats};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

/// The CPU engine, until so many calls are used up: from then on its device is lost.
struct Mortal {
    engine: CpuEngine,
    left: Arc<AtomicU32>,
}

struct MortalView<'a> {
    view: Box<dyn Projected + 'a>,
    left: &'a AtomicU32,
}

fn lives(left: &AtomicU32) -> Result<(), RasterError> {
    let used = left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(1));
    used.map(drop).map_err(|_| RasterError::Device("the accelerator was lost".into()))
}

impl Rasterizer for Mortal {
    fn name(&self) -> &'static str {
        "mortal"
    }

    fn project<'a>(
        &'a self,
        splats: &'a Splats,
        camera: &Camera,
        pose: &Pose,
        options: &ProjectOptions,
    ) -> Result<Box<dyn Projected + 'a>, RasterError> {
        let view = self.engine.project(splats, camera, pose, options)?;
        lives(&self.left)?;
        Ok(Box::new(MortalView { view, left: &self.left }))
    }
}

impl TrainingBackend for Mortal {}

impl FieldBackend for Mortal {}

impl Projected for MortalView<'_> {
    fn depths(&self) -> &[f32] {
        self.view.depths()
    }

    fn radii(&self) -> &[f32] {
        self.view.radii()
    }

    fn centres(&self) -> &[[f32; 2]] {
        self.view.centres()
    }

    fn shade(&self) -> Vec<f32> {
        self.view.shade()
    }

    fn blend(&self, channels: &Channels) -> Result<Frame, RasterError> {
        lives(self.left)?;
        self.view.blend(channels)
    }

    fn gather(&self, image: &Image) -> Result<Vec<f32>, RasterError> {
        lives(self.left)?;
        self.view.gather(image)
    }

    fn backward(
        &self,
        channels: &Channels,
        frame: &Frame,
        grad: &FrameGrad,
    ) -> Result<SplatGrads, RasterError> {
        lives(self.left)?;
        self.view.backward(channels, frame, grad)
    }

    fn shade_backward(&self, colours: &[f32], grads: &mut SplatGrads) -> Vec<f32> {
        self.view.shade_backward(colours, grads)
    }
}

/// An image, sums and gradients of one scene.
fn step(engine: &dyn Engine) -> Result<(Frame, Vec<f32>, SplatGrads), RasterError> {
    let splats = splats(&mut RasterTestRandom(3), 400, (0.01, 0.1), 1);
    let (camera, pose) = view(64, 48);
    let projected = engine.project(&splats, &camera, &pose, &ProjectOptions::default())?;
    let colours = projected.shade();
    let channels = Channels { count: 3, values: &colours };
    let frame = projected.blend(&channels)?;
    let sums = projected.gather(&frame.image)?;
    let grads = projected.backward(&channels, &frame, &FrameGrad { image: &frame.image, alpha: None })?;
    Ok((frame, sums, grads))
}

#[test]
fn a_device_lost_at_any_moment_changes_nothing_and_is_reported_once() {
    let wanted = step(&CpuEngine::new()).unwrap();
    for calls in 0..9 {
        let reasons = Arc::new(Mutex::new(Vec::new()));
        let (left, on_failure) = (Arc::new(AtomicU32::new(calls)), reasons.clone());
        let mortal = Mortal { engine: CpuEngine::new(), left };
        let on_failure = move |why: &str| on_failure.lock().unwrap().push(why.to_owned());
        let engine = FallbackEngine::new(Box::new(mortal), Box::new(CpuEngine::new()), on_failure);
        for _ in 0..2 {
            assert!(step(&engine).unwrap() == wanted, "lost after {calls} calls");
        }
        let reasons = reasons.lock().unwrap();
        let lost = if calls < 8 { vec!["the accelerator was lost".to_owned()] } else { Vec::new() };
        assert_eq!((reasons.clone(), engine.name()), (lost, "mortal"), "lost after {calls} calls");
    }
}

#[test]
fn a_mistake_of_the_caller_is_no_reason_to_change_the_engine() {
    let mortal = Mortal { engine: CpuEngine::new(), left: Arc::new(AtomicU32::new(100)) };
    let engine = FallbackEngine::new(Box::new(mortal), Box::new(CpuEngine::new()), |why: &str| {
        panic!("reported: {why}")
    });
    let (camera, pose) = view(64, 48);
    let splats = Splats { opacities: vec![0.0; 3], ..Splats::default() };
    let refused = engine.project(&splats, &camera, &pose, &ProjectOptions::default()).err();
    assert!(matches!(refused, Some(RasterError::Shape(_))), "{refused:?}");
    assert!(step(&engine).is_ok());
}
