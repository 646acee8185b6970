//! A device that fails during a run: an error with its name, or the CPU engine goes on as the fallback.

mod common;

use common::{engine, image, rules, splats, step, view};
use segwild_gpu::{AdapterChoice, GpuEngine};
use segwild_objective::{EmbedAppearance, Engine, FallbackEngine, TrainingBackend, TrainingSplats};
use segwild_raster::{Channels, CpuEngine, FrameGrad, ProjectOptions, RasterError, SplatGrads};
use segwild_selftest::training_splats_with_embeddings;
use std::sync::{Arc, Mutex};

/// The tests' adapter, whose driver does not compile one kernel.
fn without(kernel: &'static str, adapter: &str) -> GpuEngine {
    let edit = move |k: &segwild_gpu::Kernel, text: String| {
        if k.name == kernel { text.replace("@compute", "this is no kernel @compute") } else { text }
    };
    GpuEngine::with_edit(&AdapterChoice::Named(adapter.to_owned()), true, edit).expect("it opens")
}

fn gradients(engine: &dyn Engine) -> Result<SplatGrads, RasterError> {
    let scene = splats(5, 200, (0.02, 0.2));
    let (camera, pose) = view(48, 32);
    let projected = engine.project(&scene, &camera, &pose, &ProjectOptions::default())?;
    let colours = projected.shade();
    let channels = Channels { count: 3, values: &colours };
    let frame = projected.blend(&channels)?;
    projected.backward(&channels, &frame, &FrameGrad { image: &image(6, 48, 32, 3), alpha: None })
}

#[test]
fn a_kernel_that_does_not_compile_is_an_error_that_names_the_device() {
    let Some(gpu) = engine("a_kernel_that_does_not_compile_is_an_error_that_names_the_device") else {
        return;
    };
    let adapter = &gpu.adapter().name;
    for kernel in ["project", "blend", "gather", "project_backward"] {
        let error = gradients(&without(kernel, adapter)).expect_err("one kernel is none");
        let text = error.to_string();
        assert!(matches!(error, RasterError::Device(_)), "{kernel}: {text}");
        assert!(text.contains(adapter.as_str()) && text.contains(kernel), "{kernel}: {text}");
    }
}

#[test]
fn a_training_whose_kernel_does_not_compile_ends_in_words() {
    let Some(gpu) = engine("a_training_whose_kernel_does_not_compile_ends_in_words") else { return };
    let view = view(48, 32);
    let state = training_splats_with_embeddings(splats(7, 100, (0.02, 0.2)));
    let rules = rules(0.01);
    let light = EmbedAppearance::new(1, 3).photo(0);
    let compared = [
        "compose",
        "residual_histogram",
        "residual_limits",
        "pixel_weights",
        "ssim",
        "l1_ssim_backward",
        "compose_backward",
        "sky_sums",
        "sum_groups",
    ];
    for kernel in
        ["shade", "tint", "tint_backward", "shade_backward", "observe", "adam"].into_iter().chain(compared)
    {
        let broken = without(kernel, &gpu.adapter().name);
        let learn = || -> Result<TrainingSplats, RasterError> {
            let mut on_device = broken.upload_training(&mut || state.clone())?.expect("it fits");
            step(&mut *on_device, &view, Some(&light), &rules, 1, 0.1)?;
            on_device.download()
        };
        let error = learn().expect_err("one kernel is none");
        let text = error.to_string();
        assert!(matches!(error, RasterError::Device(_)) && text.contains(kernel), "{kernel}: {text}");
    }
}

#[test]
fn the_cpu_engine_takes_over_in_the_middle_of_a_step() {
    let Some(gpu) = engine("the_cpu_engine_takes_over_in_the_middle_of_a_step") else { return };
    let wanted = gradients(&CpuEngine::new()).expect("the CPU engine computes");
    let reported = Arc::new(Mutex::new(Vec::new()));
    let reports = reported.clone();
    let lost = without("project_backward", &gpu.adapter().name);
    let reports = move |why: &str| reports.lock().expect("nothing panics").push(why.to_owned());
    let engine = FallbackEngine::new(Box::new(lost), Box::new(CpuEngine::new()), reports);
    let half = gradients(&engine).expect("the CPU engine goes on");
    let close = |a: &[[f32; 3]], b: &[[f32; 3]]| {
        a.as_flattened().iter().zip(b.as_flattened()).all(|(a, b)| (a - b).abs() <= 1e-3 * (1.0 + b.abs()))
    };
    assert!(close(&half.means, &wanted.means), "the frame that was begun");
    assert!(gradients(&engine).expect("the CPU engine goes on") == wanted, "the next one");
    assert_eq!(reported.lock().expect("nothing panics").len(), 1);
}
