//! What must hold for any scene, and the same bytes on any number of threads and any instruction set.

use crate::common::{RasterTestRandom, splats, view};
use glam::Vec3;
use proptest::prelude::*;
use segwild_raster::{Channels, CpuEngine, FrameGrad, Isa, ProjectOptions, Rasterizer, SplatGrads};
use segwild_scene::{Camera, Image, Pose, Splats};

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

/// Everything the engine computes for one scene, as bits.
fn everything(
    engine: &CpuEngine,
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
    count: usize,
) -> Vec<Vec<u32>> {
    let mut random = RasterTestRandom(9);
    let values = random.many(splats.len() * count, -1.0, 1.0);
    let channels = Channels { count, values: &values };
    let projected = engine.project(splats, camera, pose, &ProjectOptions::default()).unwrap();
    let frame = projected.blend(&channels).unwrap();
    let grad = random.image(frame.image.width, frame.image.height, count);
    let mut grads = projected
        .backward(&channels, &frame, &FrameGrad { image: &grad, alpha: Some(&frame.alpha) })
        .unwrap();
    let sh = projected.shade_backward(&random.many(splats.len() * 3, -1.0, 1.0), &mut grads);
    let SplatGrads { means, log_scales, rotations, opacities, values, screen, screen_abs } = grads;
    let mut out = vec![
        bits(&frame.image.data),
        bits(&frame.alpha.data),
        bits(&projected.gather(&grad).unwrap()),
        bits(&sh),
    ];
    out.extend([bits(means.as_flattened()), bits(log_scales.as_flattened()), bits(rotations.as_flattened())]);
    out.extend([bits(&opacities), bits(&values), bits(&screen), bits(&screen_abs), bits(&projected.shade())]);
    out
}

#[test]
fn threads_do_not_change_a_byte() {
    let splats = splats(&mut RasterTestRandom(1), 1500, (0.005, 0.1), 2);
    let (camera, pose) = view(131, 77);
    for count in [1, 3, 20] {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| everything(&CpuEngine::new(), &splats, &camera, &pose, count))
        };
        let one = run(1);
        assert!(run(2) == one && run(4) == one, "{count} channels");
    }
}

#[test]
fn every_instruction_set_gives_the_same_bytes() {
    let splats = splats(&mut RasterTestRandom(2), 700, (0.005, 0.2), 3);
    let (camera, pose) = view(75, 60);
    for isa in [Isa::Avx2, Isa::Avx512] {
        if !isa.available() {
            eprintln!("skipped: every_instruction_set_gives_the_same_bytes: this processor lacks {isa:?}");
            continue;
        }
        for count in [0, 1, 2, 3, 4, 5, 17] {
            let [a, b] = [isa, Isa::Plain]
                .map(|isa| everything(&CpuEngine::with_isa(isa), &splats, &camera, &pose, count));
            assert!(a == b, "{isa:?} and plain differ with {count} channels");
        }
    }
}

#[test]
fn an_engine_counts_the_memory_that_it_keeps_and_keeps_no_more_views_than_it_may() {
    let splats = splats(&mut RasterTestRandom(4), 500, (0.01, 0.1), 1);
    let (camera, pose) = view(80, 60);
    let kept = |engine: CpuEngine, at_once: usize| {
        let project = |_| engine.project(&splats, &camera, &pose, &ProjectOptions::default()).unwrap();
        let views: Vec<_> = (0..at_once).map(project).collect();
        assert_eq!(engine.kept_bytes(), 0, "what is in use does not count");
        drop(views);
        engine.kept_bytes()
    };
    let one = kept(CpuEngine::new(), 1);
    // Depth, radius and centre at the least.
    assert!(one >= 16 * splats.len(), "{one}");
    assert_eq!(kept(CpuEngine::new().keeping(1), 3), one);
    assert_eq!(kept(CpuEngine::new(), 3), 3 * one);
}

#[test]
fn memory_used_again_changes_nothing() {
    let engine = CpuEngine::new();
    let (camera, pose) = view(64, 48);
    let (large, small) = (
        splats(&mut RasterTestRandom(3), 900, (0.01, 0.3), 1),
        splats(&mut RasterTestRandom(4), 50, (0.01, 0.3), 1),
    );
    let fresh = everything(&CpuEngine::new(), &small, &camera, &pose, 3);
    everything(&engine, &large, &camera, &pose, 5);
    assert!(everything(&engine, &small, &camera, &pose, 3) == fresh);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    #[test]
    fn constant_one_blends_to_alpha(seed in any::<u64>(), count in 1usize..60, side in 1u32..70) {
        let splats = splats(&mut RasterTestRandom(seed), count, (0.002, 0.5), 0);
        let (camera, pose) = view(side, 1 + side / 2);
        let engine = CpuEngine::new();
        let projected = engine.project(&splats, &camera, &pose, &ProjectOptions::default()).unwrap();
        for channels in [1, 3, 9] {
            let ones = vec![1.0; count * channels];
            let frame = projected.blend(&Channels { count: channels, values: &ones }).unwrap();
            for c in 0..channels {
                prop_assert_eq!(frame.image.plane(c), frame.alpha.plane(0));
            }
            prop_assert!(frame.alpha.data.iter().all(|a| (0.0..=1.0 + 1e-6).contains(a)));
        }
    }

    #[test]
    fn gather_is_the_transpose_of_blend(seed in any::<u64>(), count in 1usize..80, channels in 1usize..20) {
        let mut random = RasterTestRandom(seed);
        let splats = splats(&mut random, count, (0.005, 0.4), 0);
        let (camera, pose) = view(45, 37);
        let engine = CpuEngine::new();
        let projected = engine.project(&splats, &camera, &pose, &ProjectOptions::default()).unwrap();
        let values = random.many(count * channels, -1.0, 1.0);
        let image = random.image(45, 37, channels);
        let blended = projected.blend(&Channels { count: channels, values: &values }).unwrap().image;
        let gathered = projected.gather(&image).unwrap();
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
        let size = |a: &[f32], b: &[f32]| dot(a, a).sqrt() * dot(b, b).sqrt() + 1e-9;
        let (left, right) = (dot(&blended.data, &image.data), dot(&values, &gathered));
        let scale = size(&blended.data, &image.data).max(size(&values, &gathered));
        prop_assert!((left - right).abs() < 1e-5 * scale, "{} {}", left, right);
    }

    #[test]
    fn the_order_of_splats_does_not_matter(seed in any::<u64>(), count in 2usize..60) {
        let mut random = RasterTestRandom(seed);
        let splats = splats(&mut random, count, (0.01, 0.4), 1);
        let mut order: Vec<usize> = (0..count).collect();
        for i in (1..count).rev() {
            order.swap(i, random.next() as usize % (i + 1));
        }
        let shuffled = splats.select(&order);
        let (camera, pose) = view(50, 40);
        let engine = CpuEngine::new();
        let options = ProjectOptions::default();
        let (a, b) = (
            engine.project(&splats, &camera, &pose, &options).unwrap(),
            engine.project(&shuffled, &camera, &pose, &options).unwrap(),
        );
        let (ca, cb) = (a.shade(), b.shade());
        let (fa, fb) = (
            a.blend(&Channels { count: 3, values: &ca }).unwrap(),
            b.blend(&Channels { count: 3, values: &cb }).unwrap(),
        );
        prop_assert_eq!(&fa, &fb);
        let grad = random.image(50, 40, 3);
        let ga = a.backward(&Channels { count: 3, values: &ca }, &fa, &FrameGrad { image: &grad, alpha: None }).unwrap();
        let gb = b.backward(&Channels { count: 3, values: &cb }, &fb, &FrameGrad { image: &grad, alpha: None }).unwrap();
        for (k, &i) in order.iter().enumerate() {
            prop_assert_eq!(ga.means[i], gb.means[k]);
            prop_assert_eq!(ga.rotations[i], gb.rotations[k]);
            prop_assert_eq!(ga.opacities[i], gb.opacities[k]);
        }
    }

    #[test]
    fn a_larger_scene_renders_the_same(seed in any::<u64>(), count in 1usize..60) {
        let scene = splats(&mut RasterTestRandom(seed), count, (0.01, 0.4), 2);
        let mut large = scene.clone();
        // A power of two, so that rounding is the same and the images must be equal up to the logarithm's own.
        let factor = 1024.0;
        large.means.iter_mut().flatten().for_each(|v| *v *= factor);
        large.log_scales.iter_mut().flatten().for_each(|v| *v += factor.ln());
        let (camera, pose) = view(40, 30);
        let far = Pose { translation: pose.translation * factor, ..pose };
        let engine = CpuEngine::new();
        let options = ProjectOptions::default();
        let wide = ProjectOptions { near: options.near * factor, ..options };
        let render = |splats: &Splats, pose: &Pose, options: &ProjectOptions| -> Image {
            let projected = engine.project(splats, &camera, pose, options).unwrap();
            let colours = projected.shade();
            projected.blend(&Channels { count: 3, values: &colours }).unwrap().image
        };
        let (a, b) = (render(&scene, &pose, &options), render(&large, &far, &wide));
        for (x, y) in a.data.iter().zip(&b.data) {
            // A pixel on the edge of a splat may go either way: 1/255 of a colour.
            prop_assert!((x - y).abs() < 1e-4 || (x - y).abs() < 2.0 * 2.0 / 255.0, "{} {}", x, y);
        }
        let close = a.data.iter().zip(&b.data).filter(|(x, y)| (*x - *y).abs() < 1e-4).count();
        prop_assert!(close * 100 >= a.data.len() * 98);
    }
}

#[test]
fn wrong_shapes_are_refused_in_words() {
    let engine = CpuEngine::new();
    let (camera, pose) = view(10, 10);
    let mut scene = splats(&mut RasterTestRandom(5), 3, (0.1, 0.2), 0);
    scene.opacities.pop();
    let refused = |splats: &Splats, camera: &Camera| match engine.project(
        splats,
        camera,
        &pose,
        &ProjectOptions::default(),
    ) {
        Err(error) => error.to_string(),
        Ok(_) => panic!("not refused"),
    };
    assert!(refused(&scene, &camera).contains("opacities has 2 items where 3 splats need 3"));
    let good = splats(&mut RasterTestRandom(5), 3, (0.1, 0.2), 0);
    assert!(refused(&good, &Camera { width: 0, ..camera }).contains("0 x 10"));
    assert!(refused(&good, &Camera { fx: f32::NAN, ..camera }).contains("NaN"));
    let none = Splats::default();
    let projected = engine.project(&none, &camera, &pose, &ProjectOptions::default()).unwrap();
    let frame = projected.blend(&Channels { count: 3, values: &[] }).unwrap();
    assert!(frame.alpha.data.iter().all(|&a| a == 0.0));
    assert_eq!(
        projected
            .backward(
                &Channels { count: 3, values: &[] },
                &frame,
                &FrameGrad { image: &frame.image, alpha: None }
            )
            .unwrap(),
        SplatGrads::default()
    );
    let opposite = Pose::look_at(Vec3::new(0.0, 0.0, 9.0), Vec3::new(0.0, 0.0, 18.0), Vec3::Y);
    assert!(
        engine
            .project(&good, &camera, &opposite, &ProjectOptions::default())
            .unwrap()
            .radii()
            .iter()
            .all(|&r| r == 0.0)
    );
}
