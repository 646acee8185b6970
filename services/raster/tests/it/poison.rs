//! Values that no scene should have, and some do.

use crate::common::{RasterTestRandom, splats, view};
use segwild_raster::{Channels, CpuEngine, FrameGrad, ProjectOptions, Rasterizer};
use segwild_scene::Splats;

/// Renders and goes back; every number that leaves must be finite. Returns whether splat 0 was culled.
fn survives(name: &str, splats: &Splats) -> bool {
    let (camera, pose) = view(48, 36);
    let engine = CpuEngine::new();
    let mut culled = false;
    for antialias in [false, true] {
        let options = ProjectOptions { antialias, ..ProjectOptions::default() };
        let projected = engine.project(splats, &camera, &pose, &options).unwrap();
        let colours = projected.shade();
        let channels = Channels { count: 3, values: &colours };
        let frame = projected.blend(&channels).unwrap();
        let grad = RasterTestRandom(1).image(48, 36, 3);
        let alpha = RasterTestRandom(2).image(48, 36, 1);
        let mut grads =
            projected.backward(&channels, &frame, &FrameGrad { image: &grad, alpha: Some(&alpha) }).unwrap();
        let sh = projected.shade_backward(&grads.values.clone(), &mut grads);
        let gathered = projected.gather(&grad).unwrap();
        let all = [
            ("image", &frame.image.data[..]),
            ("alpha", &frame.alpha.data),
            ("depths", projected.depths()),
            ("radii", projected.radii()),
            ("colours", &colours),
            ("gathered", &gathered),
            ("means", grads.means.as_flattened()),
            ("log scales", grads.log_scales.as_flattened()),
            ("rotations", grads.rotations.as_flattened()),
            ("opacities", &grads.opacities),
            ("values", &grads.values),
            ("screen", &grads.screen),
            ("screen_abs", &grads.screen_abs),
            ("sh", &sh),
        ];
        for (what, values) in all {
            let bad = values.iter().position(|v| !v.is_finite());
            assert!(bad.is_none(), "{name}, antialias {antialias}: {what} is not finite at {bad:?}");
        }
        culled = projected.radii()[0] == 0.0;
    }
    culled
}

#[test]
fn poison_is_culled_or_harmless() {
    let good = splats(&mut RasterTestRandom(4), 12, (0.02, 0.2), 2);
    let (_, pose) = view(48, 36);
    let mut middle = good.clone();
    middle.means[0] = [0.02, 0.01, 0.0];
    assert!(!survives("nothing", &middle));
    // A splat on the optical axis at some depth from the eye.
    let at_depth = |z: f32| (pose.centre() + pose.rotation.row(2) * z).to_array();
    let with = |touch: &dyn Fn(&mut Splats)| {
        let mut splats = middle.clone();
        touch(&mut splats);
        splats
    };
    let denormal = f32::from_bits(1);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for k in 0..4 {
            assert!(survives("mean", &with(&|s| s.means[0][k % 3] = bad)), "mean {bad}");
            assert!(survives("log scale", &with(&|s| s.log_scales[0][k % 3] = bad)), "log scale {bad}");
            assert!(survives("rotation", &with(&|s| s.rotations[0][k] = bad)), "rotation {bad}");
        }
        assert!(survives("opacity", &with(&|s| s.opacities[0] = bad)), "opacity {bad}");
        survives("sh", &with(&|s| s.sh[3] = bad));
    }
    for value in [denormal, -denormal, f32::MIN_POSITIVE, 1e30, -1e30, f32::MAX, f32::MIN] {
        survives("mean", &with(&|s| s.means[0] = [value; 3]));
        survives("log scale", &with(&|s| s.log_scales[0] = [value; 3]));
        survives("one log scale", &with(&|s| s.log_scales[0][1] = value));
        survives("rotation", &with(&|s| s.rotations[0] = [value; 4]));
        survives("opacity", &with(&|s| s.opacities[0] = value));
        survives("sh", &with(&|s| s.sh[..27].fill(value)));
    }
    assert!(!survives("zero quaternion", &with(&|s| s.rotations[0] = [0.0; 4])));
    assert!(!survives("tiny quaternion", &with(&|s| s.rotations[0] = [1e-18, 0.0, 1e-18, 0.0])));
    assert!(!survives("opacity 1", &with(&|s| s.opacities[0] = 100.0)));
    assert!(survives("opacity 0", &with(&|s| s.opacities[0] = -100.0)));
    survives("no extent", &with(&|s| s.log_scales[0] = [-100.0; 3]));
    survives("flat", &with(&|s| s.log_scales[0] = [-1.0, -1.0, -100.0]));
    survives("needle", &with(&|s| s.log_scales[0] = [4.0, -100.0, -100.0]));
    assert!(survives("behind the camera", &with(&|s| s.means[0] = at_depth(-1.0))));
    assert!(survives("at the eye", &with(&|s| s.means[0] = at_depth(0.0))));
    assert!(survives("on the near plane", &with(&|s| s.means[0] = at_depth(0.00999))));
    assert!(!survives("past the near plane", &with(&|s| s.means[0] = at_depth(0.0101))));
    // 1e6 px wide: 2e4 units at distance 1 with a focal length of 50 px.
    assert!(!survives("wide", &with(&|s| s.log_scales[0] = [2e4f32.ln(); 3])));
    survives("wide and thin", &with(&|s| s.log_scales[0] = [2e4f32.ln(), -20.0, -20.0]));
    survives("far", &with(&|s| s.means[0] = at_depth(1e12)));
    for i in 0..12 {
        let mut all = middle.clone();
        all.opacities.fill(100.0);
        all.log_scales.fill([2.0; 3]);
        all.log_scales[i] = [-80.0; 3];
        survives("all opaque", &all);
    }
}

#[test]
fn no_low_pass_culls_splats_without_area() {
    let mut scene = splats(&mut RasterTestRandom(4), 2, (0.02, 0.2), 0);
    scene.means[0] = [0.02, 0.01, 0.0];
    scene.log_scales[0] = [-100.0; 3];
    let (camera, pose) = view(48, 36);
    let engine = CpuEngine::new();
    let options = ProjectOptions { low_pass: 0.0, ..ProjectOptions::default() };
    let projected = engine.project(&scene, &camera, &pose, &options).unwrap();
    assert_eq!(projected.radii()[0], 0.0);
    assert!(projected.radii()[1] > 0.0);
}
