//! Each kernel against its twin in the CPU engine, on the same splats.
//!
//! Numbers agree tightly, except where a splat is at a cut-off (alpha 1/255, light 1e-4, alpha 0.999): there the
//! engines may decide otherwise, and a small share of numbers may differ by the contribution of one splat at a cut-off.
//!
//! Not compared: centres of splats behind the camera, which are meaningless.

mod common;

use common::{broken, engine, image, many, misled, rules, splats, step, view};
use segwild_gpu::{AdapterChoice, GpuEngine, LEAST_PHOTOS, training_bytes};
use segwild_objective::TrainingBackend;
use segwild_raster::{
    Channels, CpuEngine, Frame, FrameGrad, ProjectOptions, Projected, RasterError, Rasterizer,
};
use segwild_scene::{Camera, Pose, Random, Splats};
use segwild_selftest::{
    STAGES, Tolerance, check, check_training, compared, gradients, projected, test_cases, training_splats,
    training_splats_with_embeddings,
};

const BLENDED: Tolerance = Tolerance::BLENDED;
const GRADIENTS: Tolerance = Tolerance::GRADIENTS;

fn compare(what: &str, got: &[f32], wanted: &[f32], allowed: &Tolerance) {
    allowed.compare(what, got, wanted).unwrap_or_else(|off| panic!("{off}"));
}

/// Both engines' projections of one view.
struct Both<'a> {
    name: String,
    cpu: Box<dyn Projected + 'a>,
    gpu: Box<dyn Projected + 'a>,
    count: usize,
    size: (usize, usize),
}

impl<'a> Both<'a> {
    fn new(
        name: &str,
        cpu: &'a CpuEngine,
        gpu: &'a GpuEngine,
        splats: &'a Splats,
        (camera, pose): &(Camera, Pose),
        options: &ProjectOptions,
    ) -> Both<'a> {
        Both {
            name: name.to_owned(),
            cpu: cpu.project(splats, camera, pose, options).expect("the CPU engine projects it"),
            gpu: gpu.project(splats, camera, pose, options).expect("the accelerator projects it"),
            count: splats.len(),
            size: (camera.width as usize, camera.height as usize),
        }
    }

    fn project(&self) {
        projected(&*self.gpu, &*self.cpu).unwrap_or_else(|off| panic!("{}: {off}", self.name));
    }

    fn blend(&self, channels: &Channels) -> (Frame, Frame) {
        let (name, c) = (&self.name, channels.count);
        let (a, b) = (self.gpu.blend(channels).unwrap(), self.cpu.blend(channels).unwrap());
        compare(&format!("{name}: blend of {c} channels"), &a.image.data, &b.image.data, &BLENDED);
        compare(&format!("{name}: alpha of {c} channels"), &a.alpha.data, &b.alpha.data, &BLENDED);
        (a, b)
    }

    fn gather(&self, channels: usize) {
        let target = image(77, self.size.0, self.size.1, channels);
        let what = format!("{}: gather of {channels} channels", self.name);
        compare(&what, &self.gpu.gather(&target).unwrap(), &self.cpu.gather(&target).unwrap(), &GRADIENTS);
    }

    fn backward(&self, channels: &Channels, frames: &(Frame, Frame), with_alpha: bool) {
        let (w, h) = self.size;
        let grad = image(78, w, h, channels.count);
        let alpha = image(79, w, h, 1);
        let grad = FrameGrad { image: &grad, alpha: with_alpha.then_some(&alpha) };
        let a = self.gpu.backward(channels, &frames.0, &grad).unwrap();
        let b = self.cpu.backward(channels, &frames.1, &grad).unwrap();
        let what = format!("{}: backward of {} channels", self.name, channels.count);
        gradients(&a, &b).unwrap_or_else(|off| panic!("{what}, {off}"));
    }

    /// All kernels for one number of channels.
    fn all(&self, channels: usize) {
        self.project();
        let values = many(&mut Random::new(5), self.count * channels, -1.0, 1.0);
        let channels = Channels { count: channels, values: &values };
        let frames = self.blend(&channels);
        self.gather(channels.count);
        self.backward(&channels, &frames, true);
    }
}

#[test]
fn random_splats_for_many_channel_counts() {
    let Some(gpu) = engine("random_splats_for_many_channel_counts") else { return };
    let cpu = CpuEngine::new();
    let scene = splats(1, 300, (0.01, 0.15));
    let (view, options) = (view(70, 52), ProjectOptions::default());
    for channels in [1, 3, 5, 16, 64] {
        Both::new("random", &cpu, gpu, &scene, &view, &options).all(channels);
    }
}

#[test]
fn gather_needs_no_blend_before_it() {
    let Some(gpu) = engine("gather_needs_no_blend_before_it") else { return };
    let cpu = CpuEngine::new();
    let scene = splats(2, 200, (0.02, 0.1));
    let both = Both::new("gather first", &cpu, gpu, &scene, &view(40, 40), &ProjectOptions::default());
    both.gather(3);
    let none = Channels { count: 0, values: &[] };
    let frames = both.blend(&none);
    both.gather(1);
    both.backward(&none, &frames, true);
    both.backward(&none, &frames, false);
}

#[test]
fn antialiasing_and_a_low_pass_of_nothing() {
    let Some(gpu) = engine("antialiasing_and_a_low_pass_of_nothing") else { return };
    let cpu = CpuEngine::new();
    let scene = splats(3, 200, (0.01, 0.1));
    for options in [
        ProjectOptions { antialias: true, ..ProjectOptions::default() },
        ProjectOptions { low_pass: 0.0, ..ProjectOptions::default() },
        ProjectOptions { near: 1.5, ..ProjectOptions::default() },
    ] {
        Both::new(&format!("{options:?}"), &cpu, gpu, &scene, &view(50, 34), &options).all(3);
    }
}

#[test]
fn adversarial_splats() {
    let Some(gpu) = engine("adversarial_splats") else { return };
    let cpu = CpuEngine::new();
    let touched = |touch: &dyn Fn(usize, &mut Splats)| {
        let mut scene = splats(4, 120, (0.01, 0.1));
        for i in 0..scene.len() {
            touch(i, &mut scene);
        }
        scene
    };
    let cases: [(&str, Splats); 8] = [
        (
            "screen-wide",
            touched(&|i, s| {
                if i % 4 == 0 {
                    s.log_scales[i] = [1.5; 3]
                }
            }),
        ),
        ("one pixel", touched(&|i, s| s.log_scales[i] = [-9.0, -8.0, -9.5])),
        ("needles", touched(&|i, s| s.log_scales[i] = [-0.5, -7.0, -7.0])),
        (
            "mostly off screen",
            touched(&|i, s| {
                if i % 3 > 0 {
                    s.means[i][0] += 3.0
                }
            }),
        ),
        ("all off screen", touched(&|i, s| s.means[i][1] += 30.0)),
        ("identical depths", touched(&|i, s| s.means[i] = s.means[i % 3])),
        ("opaque", touched(&|i, s| s.opacities[i] = 12.0)),
        ("hardly there", touched(&|i, s| s.opacities[i] = if i % 2 == 0 { -5.2 } else { -5.6 })),
    ];
    for (name, scene) in &cases {
        Both::new(name, &cpu, gpu, scene, &view(66, 50), &ProjectOptions::default()).all(3);
    }
}

#[test]
fn thousands_of_splats_on_one_pixel() {
    let Some(gpu) = engine("thousands_of_splats_on_one_pixel") else { return };
    let cpu = CpuEngine::new();
    let mut scene = splats(6, 3000, (0.005, 0.02));
    for i in 0..scene.len() {
        scene.means[i] = scene.means[i].map(|x| x * 0.01);
        // Weak enough that light passes a thousand of them.
        scene.opacities[i] = -4.8;
    }
    Both::new("thousands", &cpu, gpu, &scene, &view(36, 20), &ProjectOptions::default()).all(3);
}

#[test]
fn no_splats_and_one() {
    let Some(gpu) = engine("no_splats_and_one") else { return };
    let cpu = CpuEngine::new();
    for count in [0, 1] {
        let scene = splats(7, count, (0.1, 0.2));
        let name = format!("{count} splats");
        Both::new(&name, &cpu, gpu, &scene, &view(17, 1), &ProjectOptions::default()).all(3);
    }
}

#[test]
fn the_same_view_twice_gives_the_same_bytes() {
    let Some(gpu) = engine("the_same_view_twice_gives_the_same_bytes") else { return };
    let scene = splats(8, 300, (0.02, 0.2));
    let (camera, pose) = view(64, 48);
    let run = || {
        let projected = gpu.project(&scene, &camera, &pose, &ProjectOptions::default()).expect("projected");
        let values = projected.shade();
        let channels = Channels { count: 3, values: &values };
        let frame = projected.blend(&channels).unwrap();
        let (grad, alpha) = (image(9, 64, 48, 3), image(10, 64, 48, 1));
        let grads =
            projected.backward(&channels, &frame, &FrameGrad { image: &grad, alpha: Some(&alpha) }).unwrap();
        (frame, grads)
    };
    assert_eq!(run(), run());
}

#[test]
fn poison_is_culled_or_harmless() {
    let Some(gpu) = engine("poison_is_culled_or_harmless") else { return };
    let cpu = CpuEngine::new();
    let mut good = splats(11, 12, (0.02, 0.2));
    good.means[0] = [0.02, 0.01, 0.0];
    let numbers = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN, 1e30, -1e30];
    let mut cases: Vec<(String, Splats)> = Vec::new();
    let mut with = |name: String, touch: &dyn Fn(&mut Splats)| {
        let mut scene = good.clone();
        touch(&mut scene);
        cases.push((name, scene));
    };
    for bad in numbers {
        with(format!("mean {bad}"), &|s| s.means[0][1] = bad);
        with(format!("depth {bad}"), &|s| s.means[0][2] = bad);
        with(format!("log scale {bad}"), &|s| s.log_scales[0][2] = bad);
        with(format!("log scales {bad}"), &|s| s.log_scales[0] = [bad; 3]);
        with(format!("rotation {bad}"), &|s| s.rotations[0][3] = bad);
        with(format!("opacity {bad}"), &|s| s.opacities[0] = bad);
    }
    with("zero quaternion".into(), &|s| s.rotations[0] = [0.0; 4]);
    with("no extent".into(), &|s| s.log_scales[0] = [-100.0; 3]);
    with("wide".into(), &|s| s.log_scales[0] = [2e4f32.ln(); 3]);
    let view = view(48, 36);
    for (name, scene) in &cases {
        let both = Both::new(name, &cpu, gpu, scene, &view, &ProjectOptions::default());
        let culled = |view: &dyn Projected| view.radii().iter().map(|&r| r == 0.0).collect::<Vec<_>>();
        assert_eq!(culled(&*both.gpu), culled(&*both.cpu), "{name}: culled");
        both.all(3);
    }
}

/// A kernel, a piece of its text, its replacement, and the comparison that must find it.
const FAULTS: &[(&str, &str, &str, &str)] = &[
    ("project", "0.5 * (p.sxx + p.syy)", "0.6 * (p.sxx + p.syy)", "radii"),
    ("project", "HALF_LOG2_E / p.syy;", "HALF_LOG2_E / p.sxx;", "blend"),
    ("histogram", ">> job.y) & 15u", ">> job.y) & 7u", "blend"),
    ("scan", "plus(before, held[k])", "held[k]", "blend"),
    ("scan_add", "i / 1024u", "i / 2048u", "blend"),
    ("scatter", "+ rank[k]", "", "blend"),
    ("sorted_tile_counts", "counts[sorted[k]]", "counts[sorted[k] ^ 1u]", "blend"),
    ("emit", "column < columns.y &&", "column + 1u < columns.y &&", "blend"),
    ("ranges", "1u] = j + 1u", "1u] = j", "blend"),
    ("bucket_count", "+ BUCKET - 1u", "", "gather"),
    ("buckets", "min(BUCKET, range.y - entry)", "min(BUCKET - 1u, range.y - entry)", "gather"),
    ("blend", "min(hit.raw, ALPHA_MAX) * transmittance", "min(hit.raw, 0.9) * transmittance", "blend"),
    ("blend", "] = transmittance;", "] = 0.9 * transmittance;", "gather"),
    ("gather", "min(hit.raw, ALPHA_MAX) * t", "min(hit.raw, 0.9) * t", "gather"),
    ("sum_slots", "k < own.y", "k + 1u < own.y", "gather"),
    ("bucket_states", "passed += weight * weight_grad", "passed += 0.9 * weight * weight_grad", "backward"),
    ("backward", "let rest = remaining[p] - passed;", "let rest = remaining[p];", "backward"),
    ("backward", "abs(x), abs(y)", "x, y", "screen_abs"),
    ("project_backward", "0.5 * a * a", "0.4 * a * a", "backward"),
    ("project_backward", "dot(dq, p.quat)", "0.9 * dot(dq, p.quat)", "rotations"),
];

#[test]
fn steps_of_training_agree_for_every_degree_of_colour() {
    let Some(gpu) = engine("steps_of_training_agree_for_every_degree_of_colour") else { return };
    let (camera, pose) = view(70, 45);
    for (count, degree) in [(0, 1), (1, 2), (300, 0), (300, 1), (300, 2), (300, 3)] {
        let mut scene = splats(31, count, (0.02, 0.2));
        scene.sh_degree = degree;
        let random = &mut segwild_scene::Random::new(5);
        scene.sh = (0..count * scene.sh_stride()).map(|_| 2.0 * random.uniform() - 1.0).collect();
        // Some out of sight.
        scene.means.iter_mut().step_by(7).for_each(|mean| mean[0] += 9.0);
        let options = ProjectOptions { antialias: degree % 2 == 0, ..ProjectOptions::default() };
        for state in [training_splats(scene.clone()), training_splats_with_embeddings(scene)] {
            for step in check_training(gpu, &state, &camera, &pose, &options).expect("it trains") {
                assert!(step.off.is_none(), "{count} splats of degree {degree}: {step:?}");
            }
        }
    }
}

#[test]
fn photos_say_the_same_on_the_device() {
    let Some(gpu) = engine("photos_say_the_same_on_the_device") else { return };
    // Whole tiles and parts of them; fewer pixels than a window has; a residual's window of two pixels.
    for size in [(64, 48), (70, 45), (9, 3), (1, 1), (330, 40)] {
        for test_case in test_cases(size) {
            for part in compared(gpu, &test_case).expect("it runs") {
                assert!(part.off.is_none(), "{size:?}: {part:?}");
            }
        }
    }
}

#[test]
fn a_step_without_memory_for_its_pairs_is_repeated_and_learns_the_same() {
    let test = "a_step_without_room_for_its_pairs_is_done_again_and_learns_the_same";
    let Some(gpu) = engine(test) else { return };
    let rules = rules(0.01);
    // Points first, then the same splats large: the pairs of the second step are many times those of the first.
    let (small, large) = (splats(33, 400, (0.001, 0.002)), splats(33, 400, (0.2, 0.6)));
    let view = view(160, 120);
    let learn = |scenes: &[&Splats], key| {
        let mut after = None;
        for &scene in scenes {
            let mut on_device = gpu
                .upload_training(&mut || training_splats(scene.clone()))
                .expect("it is uploaded")
                .expect("it fits");
            let results = step(&mut *on_device, &view, None, &rules, key, 0.1).expect("it learns");
            after = Some((on_device.download().expect("it comes back"), results));
        }
        after.expect("there was a step")
    };
    let (surprised, prepared) = (learn(&[&small, &large], 51), learn(&[&large], 52));
    assert!(surprised.0.splats.means != large.means, "nothing was learnt");
    assert!(surprised == prepared);
}

#[test]
fn the_memory_that_a_training_takes_is_known_before_and_a_budget_is_kept() {
    let test = "the_memory_that_a_training_takes_is_known_before_and_a_budget_is_kept";
    let Some(gpu) = engine(test) else { return };
    let open = || GpuEngine::new(&AdapterChoice::Named(gpu.adapter().name.clone())).expect("it opens again");
    let rules = rules(1e-4);
    let scene = splats(35, 6000, (0.01, 0.04));
    let learn = |engine: &GpuEngine| -> Result<(), RasterError> {
        let mut on_device = engine
            .upload_training(&mut || training_splats(scene.clone()))?
            .ok_or(RasterError::Shape("refused".into()))?;
        for (key, size) in [(1, (320, 240)), (2, (160, 120)), (3, (300, 250)), (1, (320, 240))] {
            step(&mut *on_device, &view(size.0, size.1), None, &rules, key, 0.1)?;
            let (taken, budget) = (engine.allocated_bytes(), engine.budget());
            assert!(budget == 0 || taken <= budget, "{taken} of {budget} bytes");
        }
        Ok(())
    };
    let free = open();
    learn(&free).expect("it learns");
    let (taken, estimate) = (free.allocated_bytes(), training_bytes(6000, 320 * 240, 0, 0, None));
    println!("{taken} bytes taken, {estimate} estimated");
    assert!(taken <= estimate + LEAST_PHOTOS && estimate < 3 * taken, "{taken} taken, {estimate} estimated");
    // With less than was taken free buffers give way; with next to nothing it is refused in words.
    let near = open();
    near.keep_within(taken * 9 / 10);
    learn(&near).expect("it learns");
    let tight = open();
    tight.keep_within(1 << 20);
    let error = learn(&tight).expect_err("no room").to_string();
    assert!(error.contains("--memory-budget") || error.contains("refused"), "{error}");
}

#[test]
fn gradients_that_are_no_numbers_leave_splats_that_are() {
    let Some(gpu) = engine("gradients_that_are_no_numbers_leave_splats_that_are") else { return };
    let view = view(40, 30);
    let state = training_splats(splats(32, 60, (0.05, 0.3)));
    let mut on_device = gpu.upload_training(&mut || state.clone()).expect("it is uploaded").expect("it fits");
    let rule = segwild_objective::Rule { beta1: 0.9, beta2: 0.999, rate: 0.1, epsilon: 0.0 };
    let rules = segwild_objective::OptimiserRules::all(rule);
    // The sky's share of the gradient, in the pixels that have some.
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, 0.1] {
        step(&mut *on_device, &view, None, &rules, 3, bad).expect("it learns");
    }
    let after = on_device.download().expect("it comes back");
    for splats in [&after.splats, &after.first, &after.second] {
        let numbers = [
            splats.means.as_flattened(),
            splats.log_scales.as_flattened(),
            splats.rotations.as_flattened(),
            &splats.opacities,
            &splats.sh,
        ];
        assert!(numbers.iter().all(|of| of.iter().all(|v| v.is_finite())), "{splats:?}");
    }
    assert!(after.splats != state.splats, "nothing was learnt");
}

#[test]
fn a_fault_in_any_kernel_is_seen() {
    let Some(gpu) = engine("a_fault_in_any_kernel_is_seen") else { return };
    let choice = AdapterChoice::Named(gpu.adapter().name.clone());
    let cpu = CpuEngine::new();
    // More than a bucket in a tile, and more than a block of the sort.
    let scene = splats(12, 1500, (0.005, 0.08));
    let (view, options) = (view(50, 34), ProjectOptions::default());
    Both::new("without a fault", &cpu, gpu, &scene, &view, &options).all(3);
    for step in check(gpu).expect("every kernel runs") {
        assert!(step.off.is_none(), "without a fault: {step:?}");
    }
    for &(kernel, text, fault, seen_by) in FAULTS {
        let broken = broken(&choice, kernel, text, fault);
        let words = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            Both::new(kernel, &cpu, &broken, &scene, &view, &options).all(3);
        }))
        .expect_err(&format!("{kernel}: `{fault}` was not seen"));
        let words = words.downcast_ref::<String>().cloned().unwrap_or_default();
        assert!(words.contains(seen_by), "{kernel}: `{fault}` was to be seen in {seen_by}, and was: {words}");
        assert_eq!(misled(&STAGES, &broken, kernel, fault), None);
    }
}

#[test]
fn uploaded_splats_render_as_they_are_and_others_as_others() {
    let test = "uploaded_splats_render_as_they_are_and_others_as_others";
    let Some(gpu) = engine(test) else { return };
    let (mine, other) = (splats(61, 300, (0.02, 0.2)), splats(62, 300, (0.02, 0.2)));
    let draw = |engine: &dyn Rasterizer, splats: &Splats, size: (u32, u32)| {
        let (camera, pose) = view(size.0, size.1);
        let projected =
            engine.project(splats, &camera, &pose, &ProjectOptions::default()).expect("it projects");
        let colours = projected.shade();
        projected.blend(&Channels { count: 3, values: &colours }).expect("it blends")
    };
    let resident = gpu.upload_splats(&mine).expect("it is uploaded").expect("it fits");
    for size in [(64, 48), (50, 70)] {
        assert!(draw(&*resident, &mine, size) == draw(gpu, &mine, size));
        assert!(draw(&*resident, &other, size) == draw(gpu, &other, size));
        assert!(draw(&*resident, &mine, size) != draw(&*resident, &other, size));
    }
}
