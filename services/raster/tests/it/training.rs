//! Optimiser and looks.

use crate::common::Random;
use segwild_raster::{
    Adam, AffineLook, AnyLook, EmbedLook, GswLook, GswWidth, Look, NoLook, RANK, Sight, bake,
};
use segwild_scene::{Camera, Image, Pose, Splats};

#[test]
fn adam_follows_its_definition_and_its_items() {
    let mut random = Random(1);
    // 4099 items of 3: more than one task, and a rest that fills no vector.
    let (items, item) = (4099, 3);
    let mut adam = Adam::new(items, item);
    let mut parameters = random.many(items * item, -1.0, 1.0);
    let radii: Vec<f32> = (0..items).map(|i| f32::from(i % 5 != 2)).collect();
    let mut wanted: Vec<[f64; 3]> = parameters.iter().map(|&p| [f64::from(p), 0.0, 0.0]).collect();
    for step in 1..=5 {
        let grads = random.many(items * item, -1.0, 1.0);
        adam.step_visible(&mut parameters, &grads, 0.01, &radii);
        for (k, [p, m, v]) in wanted.iter_mut().enumerate() {
            if radii[k / item] > 0.0 {
                let g = f64::from(grads[k]);
                *m = 0.9 * *m + 0.1 * g;
                *v = 0.999 * *v + 0.001 * g * g;
                let (mh, vh) = (*m / (1.0 - 0.9f64.powi(step)), *v / (1.0 - 0.999f64.powi(step)));
                *p -= 0.01 * mh / (vh.sqrt() + 1e-15);
            }
        }
    }
    for (k, (got, wanted)) in parameters.iter().zip(&wanted).enumerate() {
        assert!((f64::from(*got) - wanted[0]).abs() < 2e-6, "parameter {k}: {got} against {}", wanted[0]);
    }

    // Items that are moved keep their moments, new ones start without.
    let grads = random.many(items * item, -1.0, 1.0);
    let mut moved = adam.clone();
    moved.select(&[7, 7, 0]);
    moved.append(1);
    assert_eq!(moved.len(), 12);
    let pick = |from: &[f32]| [&from[21..24], &from[21..24], &from[0..3], &[0.5; 3]].concat();
    let mut few = pick(&parameters);
    moved.step(&mut few, &pick(&grads), 0.01);
    adam.step(&mut parameters, &grads, 0.01);
    assert_eq!(few[..9], pick(&parameters)[..9]);
    assert!(
        (few[9]
            - (0.5 - 0.01 * (0.1 / (1.0 - 0.9f32.powi(6))) / (0.001f32 / (1.0 - 0.999f32.powi(6))).sqrt()))
        .abs()
            < 1e-5
    );

    // A gradient that is no number changes nothing for good.
    let mut adam = Adam::new(2, 1);
    let mut two = [1.0, 1.0];
    adam.step(&mut two, &[f32::NAN, f32::INFINITY], 0.1);
    adam.step(&mut two, &[1e30, 1e-30], 0.1);
    assert!(two.iter().all(|v| v.is_finite()));
}

#[test]
fn affine_look_matches_finite_differences_and_learns() {
    let mut random = Random(2);
    let image = random.image(9, 7, 3);
    let grad = random.image(9, 7, 3);
    let matrix: [f32; 12] = random.vector(-1.0, 1.0);
    let mut look = AffineLook::new(2);
    assert_eq!(look.apply(1, &image), image, "starts as the identity");
    look.set_matrix(1, matrix);
    // The loss is grad . apply(image), linear in both, so differences are exact up to rounding.
    let loss = |look: &AffineLook, image: &Image| {
        look.apply(1, image)
            .data
            .iter()
            .zip(&grad.data)
            .map(|(a, b)| f64::from(*a) * f64::from(*b))
            .sum::<f64>()
    };
    let mut trained = look.clone();
    let back = trained.backward(1, &image, &grad);
    for k in (0..image.data.len()).step_by(5) {
        let mut moved = image.clone();
        moved.data[k] += 1.0;
        let numeric = loss(&look, &moved) - loss(&look, &image);
        assert!((f64::from(back.data[k]) - numeric).abs() < 1e-4);
    }
    // The first step of Adam goes against the sign of each gradient by the rate.
    trained.pull = 0.0;
    trained.step(1.0);
    for k in 0..12 {
        let mut moved = look.clone();
        let mut m = matrix;
        m[k] += 1.0;
        moved.set_matrix(1, m);
        let numeric = loss(&moved, &image) - loss(&look, &image);
        let step = trained.matrix(1)[k] - matrix[k];
        assert!(
            (f64::from(step) + numeric.signum() * f64::from(trained.rate)).abs() < 1e-5,
            "{k}: {step} {numeric}"
        );
    }
    assert_eq!(trained.matrix(0), AffineLook::new(1).matrix(0));
    assert_eq!(trained.apply(9, &image), image, "a photo that is not known is neutral");

    // A least-squares fit finds the matrix back.
    let target = look.apply(1, &image);
    let mut fitted = AffineLook::new(1);
    fitted.fit(0, &image, &target, None, 1e-4);
    for (a, b) in fitted.matrix(0).iter().zip(matrix) {
        assert!((a - b).abs() < 1e-3, "{a} {b}");
    }
}

#[test]
fn embed_look_matches_finite_differences() {
    let mut random = Random(3);
    // More than one task's worth of splats.
    let n = 5000;
    let (colours, grad) = (random.many(3 * n, 0.0, 1.0), random.many(3 * n, -1.0, 1.0));
    let codes = random.many(3 * RANK * n, -1.0, 1.0);
    let mut look = EmbedLook::new(2, 7);
    let neutral = look.tint(9, &codes, colours.clone());
    assert_eq!(neutral, colours, "a photo that is not known is neutral");
    assert_ne!(look.vector(0), look.vector(1), "photos begin apart");
    look.set_matrix(1, random.vector(-1.0, 1.0));
    // Linear in colours, codes, matrix and vector one at a time: differences are exact up to rounding.
    let loss = |look: &EmbedLook, codes: &[f32], colours: &[f32]| {
        let shown = look.tint(1, codes, colours.to_vec());
        shown.iter().zip(&grad).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
    };
    let before = loss(&look, &codes, &colours);
    let mut trained = look.clone();
    (trained.pull, trained.vector_rate) = (0.0, trained.rate);
    let (colour_grads, code_grads) = trained.tint_backward(1, &codes, &colours, grad.clone());
    for k in (0..3 * n).step_by(1009) {
        let mut moved = colours.clone();
        moved[k] += 1.0;
        let numeric = loss(&look, &codes, &moved) - before;
        assert!((f64::from(colour_grads[k]) - numeric).abs() < 1e-3, "colour {k}: {numeric}");
    }
    for k in (0..codes.len()).step_by(4003) {
        let mut moved = codes.clone();
        moved[k] += 1.0;
        let numeric = loss(&look, &moved, &colours) - before;
        assert!((f64::from(code_grads[k]) - numeric).abs() < 1e-3, "code {k}: {numeric}");
    }
    // The first step of Adam goes against the sign of each gradient by the rate.
    trained.step(1.0);
    let check = |what: &str, k: usize, step: f32, moved: &EmbedLook| {
        let numeric = loss(moved, &codes, &colours) - before;
        let wanted = -numeric.signum() * f64::from(trained.rate);
        assert!((f64::from(step) - wanted).abs() < 1e-5, "{what} {k}: {step} {numeric}");
    };
    for k in 0..12 {
        let (mut moved, mut matrix) = (look.clone(), look.matrix(1));
        matrix[k] += 1.0;
        moved.set_matrix(1, matrix);
        check("matrix", k, trained.matrix(1)[k] - look.matrix(1)[k], &moved);
    }
    for k in 0..3 * RANK {
        let (mut moved, mut vector) = (look.clone(), look.vector(1));
        vector[k] += 1.0;
        moved.set_vector(1, vector);
        check("vector", k, trained.vector(1)[k] - look.vector(1)[k], &moved);
    }
    assert_eq!(trained.matrix(0), look.matrix(0));
    // Splats out of sight have no gradient, whatever their numbers.
    let (_, quiet) = look.clone().tint_backward(1, &[f32::NAN; 3 * RANK], &[f32::NAN; 3], vec![0.0; 3]);
    assert_eq!(quiet, [0.0; 3 * RANK]);
}

/// As many visits as a short training has for a photo.
#[test]
fn a_photo_finds_its_light_in_twenty_visits() {
    let mut random = Random(5);
    let n = 200;
    let (colours, codes) = (random.many(3 * n, 0.0, 1.0), random.many(3 * RANK * n, -0.5, 0.5));
    let mut look = EmbedLook::new(1, 7);
    let mut lit = look.clone();
    lit.set_vector(0, look.vector(0).map(|v| -v));
    let wanted = lit.tint(0, &codes, colours.clone());
    let missing = |look: &EmbedLook| -> Vec<f32> {
        let shown = look.tint(0, &codes, colours.clone());
        shown.iter().zip(&wanted).map(|(shown, wanted)| shown - wanted).collect()
    };
    let size = |missing: &[f32]| missing.iter().map(|v| v * v).sum::<f32>().sqrt();
    let before = size(&missing(&look));
    for _ in 0..20 {
        look.tint_backward(0, &codes, &colours, missing(&look));
        look.step(1.0);
    }
    let after = size(&missing(&look));
    assert!(after < before / 3.0, "{after} of {before}");
}

/// A place of `n` splats, most in the photo's frame, and a look that saw two photos of it.
fn glanced(n: usize) -> (GswLook, Vec<[f32; 3]>, Camera, Pose) {
    let mut random = Random(11);
    let means: Vec<[f32; 3]> = (0..n).map(|_| random.vector(-1.0, 1.0)).collect();
    let camera = Camera { width: 80, height: 60, fx: 70.0, fy: 70.0, cx: 40.0, cy: 30.0 };
    let pose = Pose { rotation: glam::Mat3::IDENTITY, translation: glam::Vec3::new(0.0, 0.0, 2.0) };
    let mut look = GswLook::new(3, 5, GswWidth::Cpu);
    for view in 0..2 {
        let pixels = random.many(3 * 80 * 60, 0.0, 1.0);
        let colour = |i: usize| (i % 80 > 3).then(|| [pixels[3 * i], pixels[3 * i + 1], pixels[3 * i + 2]]);
        let glance = look.glance((80, 60), &camera, &pose, colour);
        look.set_glance(view, glance);
    }
    // The last layer begins near 0, which would hide what is before it.
    let layer = random.many(look.layer().len(), -0.5, 0.5);
    look.set_layer(&layer);
    (look, means, camera, pose)
}

#[test]
fn gsw_look_matches_finite_differences() {
    let n = 1200;
    let (mut look, means, _, pose) = glanced(n);
    let mut random = Random(12);
    look.below.set_matrix(0, random.vector(-0.2, 1.0));
    let mut codes = look.first_codes(&means);
    codes.iter_mut().for_each(|v| *v += 0.3 * random.uniform(-1.0, 1.0));
    let (colours, grad) = (random.many(3 * n, 0.0, 1.0), random.many(3 * n, -1.0, 1.0));
    let radii: Vec<f32> = (0..n).map(|i| f32::from(u8::from(i % 7 != 3))).collect();
    let eye = pose.centre().to_array();
    fn sight<'a>(means: &'a [[f32; 3]], codes: &'a [f32], radii: &'a [f32], eye: [f32; 3]) -> Sight<'a> {
        Sight { means, codes, radii, eye }
    }
    // A draw in which light is read: dropout and what part of the photo is seen stay the same from run to run.
    let draw = (0..50).find(|&draw| look.impression(0, Some(draw)).is_some());
    let loss = |look: &GswLook, codes: &[f32], colours: &[f32]| {
        let light = look.impression(0, draw);
        let shown = look.tint(0, light.as_ref(), &sight(&means, codes, &radii, eye), colours.to_vec());
        let in_sight = |(k, (a, b)): (usize, (&f32, &f32))| f64::from(radii[k / 3] * a * b);
        shown.iter().zip(&grad).enumerate().map(in_sight).sum::<f64>()
    };
    let mut masked = grad.clone();
    masked.iter_mut().enumerate().for_each(|(k, g)| *g *= radii[k / 3]);
    let mut trained = look.clone();
    let light = look.impression(0, draw);
    let (colour_grads, code_grads) = trained.tint_backward(
        0,
        light.as_ref(),
        &sight(&means, &codes, &radii, eye),
        &colours,
        masked.clone(),
        &[],
    );
    // Along the gradient of each kind of number the loss rises by its square length.
    let along = |what: &str, grads: &[f32], size: f32, at: &dyn Fn(f32) -> f64| {
        let length = grads.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>();
        let step = size / length.sqrt() as f32;
        let change = (at(step) - at(-step)) / f64::from(2.0 * step);
        assert!(
            length > 0.0 && (change - length).abs() < 0.02 * length,
            "{what}: {change} instead of {length}"
        );
    };
    let moved = |values: &[f32], grads: &[f32], step: f32| -> Vec<f32> {
        values.iter().zip(grads).map(|(v, g)| v + step * g).collect()
    };
    along("colours", &colour_grads, 1.0, &|s| loss(&look, &codes, &moved(&colours, &colour_grads, s)));
    let code_size = look.code_size();
    for (what, part) in [("substance", 0..48), ("coordinates", 48..52), ("code", 52..code_size)] {
        let mut own = code_grads.clone();
        let outside = |k: usize| !part.contains(&(k % code_size));
        own.iter_mut().enumerate().filter(|(k, _)| outside(*k)).for_each(|(_, g)| *g = 0.0);
        along(what, &own, 0.02, &|s| loss(&look, &moved(&codes, &own, s), &colours));
    }
    // The networks: a step of Adam at a small rate goes down.
    (trained.net_rate, trained.point_rate) = (1e-5, 0.0);
    (trained.below.rate, trained.below.vector_rate) = (0.0, 0.0);
    let before = loss(&look, &codes, &colours);
    let mut networks = trained.clone();
    networks.step(1.0);
    assert!(loss(&networks, &codes, &colours) < before - 1e-3, "the UNet's step");
    (trained.net_rate, trained.point_rate) = (0.0, 1e-5);
    trained.step(1.0);
    assert!(loss(&trained, &codes, &colours) < before - 1e-3, "the small networks' step");
    // Splats out of sight have no gradient.
    assert!(code_grads[3 * code_size..4 * code_size].iter().all(|g| *g == 0.0));
}

#[test]
fn gsw_tones_are_what_was_trained_and_can_be_baked() {
    let n = 700;
    let (look, means, _, pose) = glanced(n);
    let codes = look.first_codes(&means);
    let mut random = Random(13);
    let colours = random.many(3 * n, 0.0, 1.0);
    let eye = pose.centre();
    let radii = vec![1.0; n];
    let sight = Sight { means: &means, codes: &codes, radii: &radii, eye: eye.to_array() };
    let direction = |i: usize| (glam::Vec3::from(means[i]) - eye).normalize().to_array();
    let mut tones = Vec::new();
    for view in 0..3 {
        let light = look.impression(view, None);
        assert_eq!(light.is_some(), view < 2, "the last one is without light");
        let trained = look.tint(view, light.as_ref(), &sight, colours.clone());
        let tone = look.tone(view, &means, &codes);
        let shaded = look.shade(&tone, &codes, &|i| Some(direction(i)), colours.clone());
        let off = trained.iter().zip(&shaded).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 1e-4, "view {view}: {off}");
        tones.push(tone);
    }
    assert!(tones[0] != tones[1] && tones[0] != tones[2]);
    // Strength 0 of a photo's light is no light.
    let light = look.impression(0, None).expect("seen");
    let below = look.below.tone(2, &means, &codes);
    let none = look.tone_of(&[(&light, 0.0)], (&below, look.layer()), &means, &codes);
    assert_eq!(none, look.tone(2, &means, &codes));
    // In a file without a network: the colours that are nearest. The head is not a sum of harmonics, but smooth.
    let splats = Splats {
        means: means.clone(),
        log_scales: vec![[-3.0; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacities: vec![0.0; n],
        sh_degree: 1,
        sh: random.many(12 * n, -0.2, 0.2),
    };
    let baked = bake(&look, &tones[0], &splats, &codes);
    let base = |sh: &[f32], i: usize, d: [f32; 3]| -> [f32; 3] {
        let h = [0.282_094_79, -0.488_602_5 * d[1], 0.488_602_5 * d[2], -0.488_602_5 * d[0]];
        std::array::from_fn(|c| 0.5 + (0..4).map(|k| h[k] * sh[12 * i + 3 * k + c]).sum::<f32>())
    };
    let own: Vec<f32> = (0..n).flat_map(|i| base(&splats.sh, i, direction(i))).collect();
    let wanted = look.shade(&tones[0], &codes, &|i| Some(direction(i)), own.clone());
    let shown: Vec<f32> = (0..n).flat_map(|i| base(&baked.sh, i, direction(i))).collect();
    let apart = |a: &[f32], b: &[f32]| {
        (a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>() / a.len() as f32).sqrt()
    };
    let (with, without) = (apart(&shown, &wanted), apart(&own, &wanted));
    assert!(with < 0.1 * without, "baked {with}, not baked {without}");
}

#[test]
fn looks_are_stored_and_read() {
    let mut look = AffineLook::new(3);
    look.set_matrix(2, [0.25; 12]);
    let gsw = GswLook::new(2, 1, GswWidth::Cpu);
    let others = [AnyLook::Embed(EmbedLook::new(2, 1)), AnyLook::Gsw(Box::new(gsw)), AnyLook::None(NoLook)];
    for look in [AnyLook::Affine(look)].into_iter().chain(others) {
        let bytes = wincode::serialize(&look).expect("it is plain data");
        let read: AnyLook = wincode::deserialize(&bytes).expect("what was written");
        assert_eq!(read, look);
        assert_eq!(read.as_look().name(), look.as_look().name());
    }
}
