//! An object's masks on a scene's photos.

use crate::RunError;
use segwild_raster::{ProjectOptions, Rasterizer, ResidentChannels};
use segwild_scene::{Camera, Image, Mask, Pose, Splats};
use segwild_segmenter::{MaskMode, owned};

/// Masks are rendered at most this many times larger than the photos were trained at, then scaled.
const FINER: u32 = 2;

/// Renders masks of labelled splats among all splats of a scene.
pub(crate) struct ObjectMasks<'a> {
    engine: &'a dyn Rasterizer,
    /// The engine that holds these splats on its device, if it has one.
    resident: Option<Box<dyn Rasterizer + 'a>>,
    splats: &'a Splats,
    /// 1 for labelled splats.
    indicator: ResidentChannels<'static>,
    options: ProjectOptions,
    mode: MaskMode,
}

impl<'a> ObjectMasks<'a> {
    pub fn new(
        engine: &'a dyn Rasterizer,
        splats: &'a Splats,
        labels: &[bool],
        options: ProjectOptions,
        mode: MaskMode,
    ) -> Result<ObjectMasks<'a>, RunError> {
        let mut indicator =
            ResidentChannels::new(1, labels.iter().map(|&l| f32::from(u8::from(l))).collect::<Vec<_>>());
        indicator.upload(engine)?;
        Ok(ObjectMasks { engine, resident: engine.upload_splats(splats)?, splats, indicator, options, mode })
    }

    /// Blends the indicator of the labelled splats: their share of each pixel, 0 to 1. The image is up to twice as
    /// large as the photo at long side `size`.
    pub fn share(&self, full: &Camera, pose: &Pose, size: u32) -> Result<Image, RunError> {
        let camera = full.scaled_to(size * FINER);
        if self.splats.is_empty() {
            return Ok(Image::filled(camera.width as usize, camera.height as usize, 1, 0.0));
        }
        let engine = self.resident.as_deref().unwrap_or(self.engine);
        let projected = engine.project(self.splats, &camera, pose, &self.options)?;
        Ok(projected.blend_resident(&self.indicator)?.image)
    }

    /// The mask of a photo, at the photo's full size: the pixels where the labelled splats' share decides.
    pub fn mask(&self, share: &Image, full: &Camera) -> Mask {
        owned(share, self.mode, (full.width, full.height))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use segwild_gpu::{AdapterChoice, GpuEngine, adapters};

    #[test]
    fn an_objects_masks_bring_no_splat_to_an_accelerator_twice() {
        let Some(adapter) = adapters().into_iter().next() else {
            println!("skipped: an_objects_masks_bring_no_splat_to_an_accelerator_twice: no adapter");
            return;
        };
        let engine = GpuEngine::new(&AdapterChoice::Named(adapter.name)).expect("it opens");
        let n = 3000;
        let mean = |i: usize| [(i % 60) as f32 / 30.0 - 1.0, (i / 60) as f32 / 25.0 - 1.0, 4.0];
        let splats = Splats {
            means: (0..n).map(mean).collect(),
            log_scales: vec![[-3.0; 3]; n],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacities: vec![4.0; n],
            sh: vec![0.0; 3 * n],
            sh_degree: 0,
        };
        let labels: Vec<bool> = (0..n).map(|i| i % 60 < 30).collect();
        let source =
            ObjectMasks::new(&engine, &splats, &labels, ProjectOptions::default(), MaskMode::Visible)
                .expect("it is uploaded");
        let before = engine.work_counts().uploaded_bytes;
        for photo in 0..3 {
            let camera = Camera { width: 60, height: 40, fx: 80.0, fy: 80.0, cx: 30.0, cy: 20.0 };
            let eye = Vec3::new(0.1 * photo as f32, 0.0, 0.0);
            let pose = Pose::look_at(eye, eye + Vec3::Z, Vec3::NEG_Y);
            let share = source.share(&camera, &pose, 60).expect("it is rendered");
            let mask = source.mask(&share, &camera);
            assert!(mask.get(10, 20) && !mask.get(55, 20), "the left half");
        }
        let crossed = engine.work_counts().uploaded_bytes - before;
        assert!(crossed < 1000, "{crossed} bytes for three photos of {n} splats");
    }
}
