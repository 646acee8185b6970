//! Checks the kernels of training: one step on the device against the same step on the host.

use crate::frame::interleaved;
use crate::kernel_check::KernelCheck;
use crate::mismatch::Mismatch;
use crate::tolerance::Tolerance;
use segwild_gpu::GpuEngine;
use segwild_gpu::probe::{TrainedStep, training_step};
use segwild_objective::{
    Adam, Appearance, EmbedAppearance, EmbedLight, OptimiserRules, Reshaped, Rule, SplatEmbeddings,
    TrainingBackend, TrainingSplats,
};
use segwild_raster::{Channels, CpuEngine, Frame, FrameGrad, ProjectOptions, RasterError, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Random, Splats};

/// A training state with moments as in the middle of a training.
pub fn training_splats(splats: Splats) -> TrainingSplats {
    let random = &mut Random::new(21);
    let mut like = |from: f32, to: f32| {
        let mut within = || from + (to - from) * random.uniform();
        Splats {
            means: splats.means.iter().map(|_| [0; 3].map(|_| within())).collect(),
            log_scales: splats.means.iter().map(|_| [0; 3].map(|_| within())).collect(),
            rotations: splats.means.iter().map(|_| [0; 4].map(|_| within())).collect(),
            opacities: splats.means.iter().map(|_| within()).collect(),
            sh: splats.sh.iter().map(|_| within()).collect(),
            sh_degree: splats.sh_degree,
        }
    };
    let (first, second) = (like(-0.5, 0.5), like(0.1, 1.0));
    let sums = splats.means.iter().map(|_| [0; 4].map(|_| random.uniform())).collect();
    TrainingSplats {
        splats,
        first,
        second,
        sums,
        splat_embeddings: SplatEmbeddings::default(),
        networks: None,
    }
}

/// The same with appearance embeddings.
pub fn training_splats_with_embeddings(splats: Splats) -> TrainingSplats {
    let random = &mut Random::new(23);
    let numbers = splats.len() * EmbedAppearance::EMBEDDING_SIZE;
    let mut like =
        |from: f32, to: f32| (0..numbers).map(|_| from + (to - from) * random.uniform()).collect::<Vec<_>>();
    let splat_embeddings =
        SplatEmbeddings { values: like(-0.1, 0.1), first: like(-0.5, 0.5), second: like(0.1, 1.0) };
    TrainingSplats { splat_embeddings, ..training_splats(splats) }
}

/// Compares one step of training on the device, of splats in sight of a camera, with the host's.
pub fn training(
    engine: &GpuEngine,
    state: &TrainingSplats,
    camera: &Camera,
    pose: &Pose,
    options: &ProjectOptions,
) -> Result<Vec<KernelCheck>, RasterError> {
    let random = &mut Random::new(22);
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut image = |channels: usize| Image {
        data: (0..width * height * channels).map(|_| random.uniform() - 0.5).collect(),
        ..Image::zeros(width, height, channels)
    };
    let (by_colour, by_alpha, error) = (image(3), image(1), image(1));
    let grad = FrameGrad { image: &by_colour, alpha: Some(&by_alpha) };
    let rule = |rate: f32| Rule { beta1: 0.9, beta2: 0.95, rate, epsilon: 1e-6 };
    let rules = OptimiserRules {
        means: rule(0.01),
        log_scales: rule(0.02),
        rotations: rule(0.03),
        opacities: rule(0.04),
        base: rule(0.05),
        higher: rule(0.06),
        splat_embeddings: rule(0.07),
        kept: 0.97,
    };
    // With another light than the initial one.
    let mut appearance = EmbedAppearance::new(1, 24);
    appearance.set_matrix(0, [0.9, 0.1, -0.05, 0.02, 0.05, 1.1, 0.1, -0.03, -0.1, 0.05, 0.8, 0.04]);
    let light = (!state.splat_embeddings.values.is_empty()).then(|| appearance.photo(0));
    let (frame, wanted, by_light) =
        on_the_host(state, camera, pose, options, &grad, &error, &rules, &appearance)?;
    let TrainedStep { rendered, light: lit, state: got } =
        training_step(engine, state, (camera, pose, options), light.as_ref(), (&grad, &error), &rules)?;
    let wide = interleaved(&frame);
    let blended = Tolerance::BLENDED.compare("colours and alpha", &rendered, &wide);
    let sums = Tolerance::GRADIENTS.compare("sums", got.sums.as_flattened(), wanted.sums.as_flattened());
    type SplatArray = fn(&Splats) -> &[f32];
    let compare = |name: &str, of: SplatArray| {
        let moved = |state: &TrainingSplats, before: &TrainingSplats| -> Vec<f32> {
            of(&state.splats).iter().zip(of(&before.splats)).map(|(a, b)| a - b).collect()
        };
        let tolerance = Tolerance::GRADIENTS;
        tolerance.compare(&format!("first moments of the {name}"), of(&got.first), of(&wanted.first))?;
        tolerance.compare(&format!("second moments of the {name}"), of(&got.second), of(&wanted.second))?;
        tolerance.compare(&format!("steps of the {name}"), &moved(&got, state), &moved(&wanted, state))
    };
    // These do not depend on colours.
    let shapes: [(&str, SplatArray); 3] = [
        ("log scales", |s| s.log_scales.as_flattened()),
        ("rotations", |s| s.rotations.as_flattened()),
        ("opacities", |s| &s.opacities),
    ];
    let coloured: [(&str, SplatArray); 2] =
        [("harmonics", |s| &s.sh), ("centres", |s| s.means.as_flattened())];
    let all = |of: &[(&str, SplatArray)]| of.iter().try_for_each(|&(name, of)| compare(name, of));
    let tinted = || {
        let (Some(lit), Some(light)) = (lit, by_light) else { return Ok(()) };
        let (got, wanted, before) =
            (&got.splat_embeddings, &wanted.splat_embeddings, &state.splat_embeddings);
        let moved = |after: &SplatEmbeddings| -> Vec<f32> {
            after.values.iter().zip(&before.values).map(|(a, b)| a - b).collect()
        };
        let tolerance = Tolerance::GRADIENTS;
        tolerance.compare("the light's gradient", &lit, &light)?;
        tolerance.compare("first moments of the embeddings", &got.first, &wanted.first)?;
        tolerance.compare("second moments of the embeddings", &got.second, &wanted.second)?;
        tolerance.compare("steps of the embeddings", &moved(got), &moved(wanted))
    };
    let (shapes, coloured) = (all(&shapes), all(&coloured));
    let reshaped = reshaped(engine, state)?;
    let off = |kernels, off: Result<(), Mismatch>| KernelCheck { kernels, off: off.err() };
    Ok(if light.is_some() {
        // The splats without embeddings have checked the other kernels.
        let rest = tinted().and(coloured).and(sums).and(shapes);
        vec![
            off(&["select"], reshaped),
            off(&["tint"], blended),
            off(&["tint_backward", "adam", "sum_groups"], rest),
        ]
    } else {
        vec![
            off(&["select"], reshaped),
            off(&["shade"], blended),
            off(&["observe"], sums),
            off(&["adam"], shapes),
            off(&["shade_backward"], coloured),
        ]
    })
}

/// Compares splats after a possible density control: some removed, some duplicated, some with moments reset.
fn reshaped(engine: &GpuEngine, state: &TrainingSplats) -> Result<Result<(), Mismatch>, RasterError> {
    let random = &mut Random::new(25);
    let n = state.splats.len();
    let parents: Vec<usize> = (0..n).filter(|i| i % 5 != 2).chain((0..n).step_by(3)).collect();
    let forgotten: Vec<bool> = parents.iter().map(|_| random.below(3) == 0).collect();
    let mut shapes = state.splats.uncoloured().select(&parents);
    shapes.means.iter_mut().for_each(|mean| mean[1] += 0.5);
    let of = |splats: &Splats, forget: bool| {
        let mut splats = splats.select(&parents);
        let k = splats.sh_stride();
        for i in (0..parents.len()).filter(|&i| forget && forgotten[i]) {
            (splats.means[i], splats.log_scales[i], splats.rotations[i]) = ([0.0; 3], [0.0; 3], [0.0; 4]);
            splats.sh[i * k..(i + 1) * k].fill(0.0);
        }
        splats
    };
    let moments = |splats| Splats { opacities: vec![0.0; parents.len()], ..of(splats, true) };
    let splat_embeddings = |splat_embeddings: &[f32], forget: bool| -> Vec<f32> {
        let size = splat_embeddings.len().checked_div(n).unwrap_or(0);
        let embedding = |(k, &i): (usize, &usize)| {
            let known = if forget && forgotten[k] { 0.0 } else { 1.0 };
            splat_embeddings[i * size..(i + 1) * size].iter().map(move |v| known * v)
        };
        parents.iter().enumerate().flat_map(embedding).collect()
    };
    let coloured = of(&state.splats, false);
    let wanted = TrainingSplats {
        splats: Splats { sh: coloured.sh, sh_degree: coloured.sh_degree, ..shapes.clone() },
        first: moments(&state.first),
        second: moments(&state.second),
        sums: vec![[0.0; 4]; parents.len()],
        splat_embeddings: SplatEmbeddings {
            values: splat_embeddings(&state.splat_embeddings.values, false),
            first: splat_embeddings(&state.splat_embeddings.first, true),
            second: splat_embeddings(&state.splat_embeddings.second, true),
        },
        networks: state.networks.clone(),
    };
    let Some(mut on_device) = engine.upload_training(&mut || state.clone())? else {
        return Err(RasterError::Shape("the splats do not fit where they are trained".into()));
    };
    let shapes_before = on_device.shapes()?;
    let parents = parents.iter().map(|&i| i as u32).collect();
    if !on_device.reshape(&Reshaped { shapes, parents, forgotten, opacities_forgotten: true })? {
        return Err(RasterError::Shape("the splats do not fit where they are trained".into()));
    }
    let got = on_device.download()?;
    Ok(if shapes_before != (state.splats.uncoloured(), state.sums.clone()) {
        Err(Mismatch::Changed)
    } else if got != wanted {
        Err(Mismatch::Reshaped { splats: n })
    } else {
        Ok(())
    })
}

/// A step by the CPU engine: the render, the state afterwards, and the gradient of the photo's parameters.
#[expect(clippy::too_many_arguments, reason = "a whole step of training")]
fn on_the_host(
    state: &TrainingSplats,
    camera: &Camera,
    pose: &Pose,
    options: &ProjectOptions,
    grad: &FrameGrad,
    error: &Image,
    rules: &OptimiserRules,
    appearance: &EmbedAppearance,
) -> Result<(Frame, TrainingSplats, Option<EmbedLight>), RasterError> {
    let cpu = CpuEngine::new();
    let splats = &state.splats;
    let projected = cpu.project(splats, camera, pose, options)?;
    let colours = projected.shade();
    let mut appearance = appearance.clone();
    let splat_embeddings = &state.splat_embeddings.values;
    let lit = !splat_embeddings.is_empty();
    let tinted = if lit { appearance.tint(0, splat_embeddings, colours.clone()) } else { colours.clone() };
    let channels = Channels { count: 3, values: &tinted };
    let frame = projected.blend(&channels)?;
    let mut grads = projected.backward(&channels, &frame, grad)?;
    let mut by_colour = std::mem::take(&mut grads.values);
    let mut by_embedding = Vec::new();
    if lit {
        (by_colour, by_embedding) = appearance.tint_backward(0, splat_embeddings, &colours, by_colour);
    }
    let sh_grads = projected.shade_backward(&by_colour, &mut grads);
    let mut after = state.clone();
    let (width, long) = (camera.width as f32, camera.width.max(camera.height) as f32);
    for (i, sums) in after.sums.iter_mut().enumerate() {
        let (radius, [x, y]) = (projected.radii()[i], projected.centres()[i]);
        if radius > 0.0 {
            let inside = x >= 0.0 && y >= 0.0 && x < width && y < camera.height as f32;
            let here = if inside { error.data[y as usize * error.width + x as usize] } else { 0.0 };
            let share = sums[3].max(radius / long);
            *sums = [sums[0] + grads.screen_abs[i], sums[1] + here, sums[2] + 1.0, share];
        }
    }
    let TrainingSplats { splats: s, first, second, .. } = &mut after;
    let step = |p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32], rule: Rule| {
        let mut adam = Adam::new(p.len(), 1);
        adam.set_moments(m.to_vec(), v.to_vec());
        adam.step_by(p, g, rule);
        let [first, second] = adam.moments();
        m.copy_from_slice(first);
        v.copy_from_slice(second);
    };
    macro_rules! flat {
        ($field:ident, $grads:expr, $rule:expr) => {
            step(
                s.$field.as_flattened_mut(),
                first.$field.as_flattened_mut(),
                second.$field.as_flattened_mut(),
                $grads.as_flattened(),
                $rule,
            )
        };
    }
    flat!(means, grads.means, rules.means);
    flat!(log_scales, grads.log_scales, rules.log_scales);
    flat!(rotations, grads.rotations, rules.rotations);
    let opacities = (&mut s.opacities, &mut first.opacities, &mut second.opacities);
    step(opacities.0, opacities.1, opacities.2, &grads.opacities, rules.opacities);
    let k = s.sh_stride();
    for (i, g) in sh_grads.chunks_exact(k).enumerate() {
        for (from, to, rule) in [(0, 3, rules.base), (3, k, rules.higher)] {
            let at = i * k + from..i * k + to;
            let (p, m) = (&mut s.sh[at.clone()], &mut first.sh[at.clone()]);
            step(p, m, &mut second.sh[at], &g[from..to], rule);
        }
    }
    if lit {
        let SplatEmbeddings { values, first, second } = &mut after.splat_embeddings;
        let size = EmbedAppearance::EMBEDDING_SIZE;
        for i in (0..state.splats.len()).filter(|&i| projected.radii()[i] > 0.0) {
            let at = i * size..(i + 1) * size;
            let (p, m) = (&mut values[at.clone()], &mut first[at.clone()]);
            step(p, m, &mut second[at.clone()], &by_embedding[at.clone()], rules.splat_embeddings);
            values[at].iter_mut().for_each(|v| *v *= rules.kept);
        }
    }
    Ok((frame, after, lit.then(|| appearance.gradient(0)).flatten()))
}
