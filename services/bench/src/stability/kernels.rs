//! The kernels at the ends of what f32 holds: splats from far under a pixel to far over the screen.

use super::stress::PROTOCOL;
use glam::{DQuat, Vec3};
use segwild_eval::record::Record;
use segwild_raster::reference::{Parameters, Reference};
use segwild_raster::{
    Channels, CpuEngine, Frame, FrameGrad, ProjectOptions, RasterError, Rasterizer, SplatGrads,
};
use segwild_scene::{Camera, Pose, Splats};
use segwild_synthetic::random::Rng;
use std::collections::BTreeMap;

/// Standard deviations in pixels.
const SIZES: [f64; 9] = [1e-6, 1e-3, 0.1, 1.0, 10.0, 100.0, 1e3, 1e5, 1e7];
const SPLATS: usize = 40;

/// For each size of the splats: the largest difference of the image from the f64 reference (where f32 cannot decide a
/// cut-off in another way), whether everything, gradients too, is finite, and the light that arrives.
pub fn kernels() -> Vec<Record> {
    SIZES.iter().map(|&size| kernel(size)).collect()
}

fn kernel(size: f64) -> Record {
    let camera = Camera { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
    let pose = Pose::look_at(Vec3::new(0.0, 0.0, -2.0), Vec3::ZERO, Vec3::NEG_Y);
    let mut rng = Rng::new(7, size.to_bits());
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    let mut values = Vec::new();
    for _ in 0..SPLATS {
        let mean = rng.triple(-0.6, 0.6);
        let depth = mean.z + 2.0;
        let scale = (size as f32 * depth / 60.0).ln();
        splats.means.push(mean.to_array());
        splats.log_scales.push([scale, scale + 0.2, scale - 0.3]);
        let turn = DQuat::from_euler(glam::EulerRot::XYZ, f64::from(rng.unit()), f64::from(rng.unit()), 0.3);
        splats.rotations.push([turn.w as f32, turn.x as f32, turn.y as f32, turn.z as f32]);
        splats.opacities.push(rng.range(-2.0, 2.0));
        splats.sh.extend([0.1, 0.0, -0.1]);
        values.extend(rng.triple(0.0, 1.0).to_array());
    }
    let options = ProjectOptions::default();
    let mut numbers = BTreeMap::new();
    let mut notes = Vec::new();
    let engine = CpuEngine::new();
    let render = || -> Result<(Frame, SplatGrads), RasterError> {
        let projected = engine.project(&splats, &camera, &pose, &options)?;
        let channels = Channels { count: 3, values: &values };
        let frame = projected.blend(&channels)?;
        let grad = FrameGrad { image: &frame.image, alpha: Some(&frame.alpha) };
        let grads = projected.backward(&channels, &frame, &grad)?;
        Ok((frame, grads))
    };
    match render() {
        Ok((frame, grads)) => {
            let finite = frame.image.data.iter().chain(&frame.alpha.data).all(|v| v.is_finite())
                && grads.means.as_flattened().iter().all(|v| v.is_finite())
                && grads.log_scales.as_flattened().iter().all(|v| v.is_finite())
                && grads.rotations.as_flattened().iter().all(|v| v.is_finite())
                && grads.opacities.iter().chain(&grads.values).all(|v| v.is_finite());
            let reference = Reference { camera, pose, options, cutoffs: true };
            let wide: Vec<f64> = values.iter().map(|v| f64::from(*v)).collect();
            let truth = reference.render(&Parameters::of(&splats), &wide, 3);
            let n = frame.alpha.data.len();
            let sure = (0..n).filter(|i| !truth.unsure[*i]);
            let off = sure.flat_map(|i| {
                let image = &frame.image;
                let truth = &truth.image;
                (0..3).map(move |c| (f64::from(image.data[c * n + i]) - truth[c * n + i]).abs())
            });
            numbers.insert("off".to_owned(), off.fold(0.0, f64::max));
            numbers.insert("finite".to_owned(), f64::from(u8::from(finite)));
            let light = frame.alpha.data.iter().map(|v| f64::from(*v)).sum::<f64>() / n as f64;
            numbers.insert("light".to_owned(), light);
        }
        Err(refused) => notes.push(refused.to_string()),
    }
    Record {
        protocol: PROTOCOL.into(),
        scene: format!("{SPLATS} splats"),
        setting: "kernels".into(),
        at: Some(size),
        numbers,
        notes,
        ..Record::default()
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn splats_of_any_size_are_finite_and_as_in_f64() {
        for record in super::kernels() {
            let size = record.at.unwrap();
            assert_eq!(record.numbers.get("finite"), Some(&1.0), "{size} px: {:?}", record.notes);
            assert!(record.numbers["off"] < 1e-3, "{size} px: {}", record.numbers["off"]);
        }
    }
}
