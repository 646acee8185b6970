//! Optimiser and appearance models.

use crate::common::RasterTestRandom;
use segwild_objective::{
    Adam, AffineAppearance, AnyAppearance, Appearance, EmbedAppearance, GswAppearance, GswWidth,
    NoAppearance, RANK, VisibleSplats, bake,
};
use segwild_scene::{Camera, Image, Pose, Splats};

#[test]
fn adam_follows_its_definition_and_its_items() {
    let mut random = RasterTestRandom(1);
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
fn affine_appearance_matches_finite_differences_and_learns() {
    let mut random = RasterTestRandom(2);
    let image = random.image(9, 7, 3);
    let grad = random.image(9, 7, 3);
    let matrix: [f32; 12] = random.vector(-1.0, 1.0);
    let mut appearance = AffineAppearance::new(2);
    assert_eq!(appearance.apply(1, &image), image, "starts as the identity");
    appearance.set_matrix(1, matrix);
    // The loss is grad . apply(image), linear in both, so differences are exact up to rounding.
    let loss = |appearance: &AffineAppearance, image: &Image| {
        appearance
            .apply(1, image)
            .data
            .iter()
            .zip(&grad.data)
            .map(|(a, b)| f64::from(*a) * f64::from(*b))
            .sum::<f64>()
    };
    let mut trained = appearance.clone();
    let back = trained.backward(1, &image, &grad);
    for k in (0..image.data.len()).step_by(5) {
        let mut moved = image.clone();
        moved.data[k] += 1.0;
        let numeric = loss(&appearance, &moved) - loss(&appearance, &image);
        assert!((f64::from(back.data[k]) - numeric).abs() < 1e-4);
    }
    // The first step of Adam goes against the sign of each gradient by the rate.
    trained.pull = 0.0;
    trained.step(1.0);
    for k in 0..12 {
        let mut moved = appearance.clone();
        let mut m = matrix;
        m[k] += 1.0;
        moved.set_matrix(1, m);
        let numeric = loss(&moved, &image) - loss(&appearance, &image);
        let step = trained.matrix(1)[k] - matrix[k];
        assert!(
            (f64::from(step) + numeric.signum() * f64::from(trained.rate)).abs() < 1e-5,
            "{k}: {step} {numeric}"
        );
    }
    assert_eq!(trained.matrix(0), AffineAppearance::new(1).matrix(0));
    assert_eq!(trained.apply(9, &image), image, "a photo that is not known is neutral");

    // A least-squares fit finds the matrix back.
    let target = appearance.apply(1, &image);
    let mut fitted = AffineAppearance::new(1);
    fitted.fit(0, &image, &target, None, 1e-4);
    for (a, b) in fitted.matrix(0).iter().zip(matrix) {
        assert!((a - b).abs() < 1e-3, "{a} {b}");
    }
}

#[test]
fn embed_appearance_matches_finite_differences() {
    let mut random = RasterTestRandom(3);
    // More than one task's worth of splats.
    let n = 5000;
    let (colours, grad) = (random.many(3 * n, 0.0, 1.0), random.many(3 * n, -1.0, 1.0));
    let splat_embeddings = random.many(3 * RANK * n, -1.0, 1.0);
    let mut appearance = EmbedAppearance::new(2, 7);
    let neutral = appearance.tint(9, &splat_embeddings, colours.clone());
    assert_eq!(neutral, colours, "a photo that is not known is neutral");
    assert_ne!(appearance.vector(0), appearance.vector(1), "photos start apart");
    appearance.set_matrix(1, random.vector(-1.0, 1.0));
    // Linear in colours, splat embeddings, matrix and vector one at a time: differences are exact up to rounding.
    let loss = |appearance: &EmbedAppearance, splat_embeddings: &[f32], colours: &[f32]| {
        let shown = appearance.tint(1, splat_embeddings, colours.to_vec());
        shown.iter().zip(&grad).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
    };
    let before = loss(&appearance, &splat_embeddings, &colours);
    let mut trained = appearance.clone();
    (trained.pull, trained.vector_rate) = (0.0, trained.rate);
    let (colour_grads, embedding_grads) = trained.tint_backward(1, &splat_embeddings, &colours, grad.clone());
    for k in (0..3 * n).step_by(1009) {
        let mut moved = colours.clone();
        moved[k] += 1.0;
        let numeric = loss(&appearance, &splat_embeddings, &moved) - before;
        assert!((f64::from(colour_grads[k]) - numeric).abs() < 1e-3, "colour {k}: {numeric}");
    }
    for k in (0..splat_embeddings.len()).step_by(4003) {
        let mut moved = splat_embeddings.clone();
        moved[k] += 1.0;
        let numeric = loss(&appearance, &moved, &colours) - before;
        assert!((f64::from(embedding_grads[k]) - numeric).abs() < 1e-3, "embedding {k}: {numeric}");
    }
    // The first step of Adam goes against the sign of each gradient by the rate.
    trained.step(1.0);
    let check = |what: &str, k: usize, step: f32, moved: &EmbedAppearance| {
        let numeric = loss(moved, &splat_embeddings, &colours) - before;
        let wanted = -numeric.signum() * f64::from(trained.rate);
        assert!((f64::from(step) - wanted).abs() < 1e-5, "{what} {k}: {step} {numeric}");
    };
    for k in 0..12 {
        let (mut moved, mut matrix) = (appearance.clone(), appearance.matrix(1));
        matrix[k] += 1.0;
        moved.set_matrix(1, matrix);
        check("matrix", k, trained.matrix(1)[k] - appearance.matrix(1)[k], &moved);
    }
    for k in 0..3 * RANK {
        let (mut moved, mut vector) = (appearance.clone(), appearance.vector(1));
        vector[k] += 1.0;
        moved.set_vector(1, vector);
        check("vector", k, trained.vector(1)[k] - appearance.vector(1)[k], &moved);
    }
    assert_eq!(trained.matrix(0), appearance.matrix(0));
    // Splats out of sight have no gradient, whatever their numbers.
    let (_, quiet) = appearance.clone().tint_backward(1, &[f32::NAN; 3 * RANK], &[f32::NAN; 3], vec![0.0; 3]);
    assert_eq!(quiet, [0.0; 3 * RANK]);
}

/// As many visits as a short training has for a photo.
#[test]
fn a_photo_finds_its_light_in_twenty_visits() {
    let mut random = RasterTestRandom(5);
    let n = 200;
    let (colours, splat_embeddings) = (random.many(3 * n, 0.0, 1.0), random.many(3 * RANK * n, -0.5, 0.5));
    let mut appearance = EmbedAppearance::new(1, 7);
    let mut lit = appearance.clone();
    lit.set_vector(0, appearance.vector(0).map(|v| -v));
    let wanted = lit.tint(0, &splat_embeddings, colours.clone());
    let missing = |appearance: &EmbedAppearance| -> Vec<f32> {
        let shown = appearance.tint(0, &splat_embeddings, colours.clone());
        shown.iter().zip(&wanted).map(|(shown, wanted)| shown - wanted).collect()
    };
    let size = |missing: &[f32]| missing.iter().map(|v| v * v).sum::<f32>().sqrt();
    let before = size(&missing(&appearance));
    for _ in 0..20 {
        appearance.tint_backward(0, &splat_embeddings, &colours, missing(&appearance));
        appearance.step(1.0);
    }
    let after = size(&missing(&appearance));
    assert!(after < before / 3.0, "{after} of {before}");
}

/// A scene of `n` splats, most in the photo's frame, and an appearance model with two of its photos.
fn conditioned(n: usize) -> (GswAppearance, Vec<[f32; 3]>, Camera, Pose) {
    let mut random = RasterTestRandom(11);
    let means: Vec<[f32; 3]> = (0..n).map(|_| random.vector(-1.0, 1.0)).collect();
    let camera = Camera { width: 80, height: 60, fx: 70.0, fy: 70.0, cx: 40.0, cy: 30.0 };
    let pose = Pose { rotation: glam::Mat3::IDENTITY, translation: glam::Vec3::new(0.0, 0.0, 2.0) };
    let mut appearance = GswAppearance::new(3, 5, GswWidth::Cpu);
    for view in 0..2 {
        let pixels = random.many(3 * 80 * 60, 0.0, 1.0);
        let colour = |i: usize| (i % 80 > 3).then(|| [pixels[3 * i], pixels[3 * i + 1], pixels[3 * i + 2]]);
        let image_conditioning = appearance.image_conditioning((80, 60), &camera, &pose, colour);
        appearance.set_image_conditioning(view, image_conditioning);
    }
    // The last layer starts near 0, which would hide the gradients of the layers before it.
    let layer = random.many(appearance.layer().len(), -0.5, 0.5);
    appearance.set_layer(&layer);
    (appearance, means, camera, pose)
}

#[test]
fn gsw_appearance_matches_finite_differences() {
    let n = 1200;
    let (mut appearance, means, _, pose) = conditioned(n);
    let mut random = RasterTestRandom(12);
    appearance.below.set_matrix(0, random.vector(-0.2, 1.0));
    let mut splat_embeddings = appearance.first_embeddings(&means);
    splat_embeddings.iter_mut().for_each(|v| *v += 0.3 * random.uniform(-1.0, 1.0));
    let (colours, grad) = (random.many(3 * n, 0.0, 1.0), random.many(3 * n, -1.0, 1.0));
    let radii: Vec<f32> = (0..n).map(|i| f32::from(u8::from(i % 7 != 3))).collect();
    let eye = pose.centre().to_array();
    fn sight<'a>(
        means: &'a [[f32; 3]],
        splat_embeddings: &'a [f32],
        radii: &'a [f32],
        eye: [f32; 3],
    ) -> VisibleSplats<'a> {
        VisibleSplats { means, splat_embeddings, radii, eye }
    }
    // A draw in which light is read: dropout and the visible part of the photo stay the same from run to run.
    let draw = (0..50).find(|&draw| appearance.appearance_maps(0, Some(draw)).is_some());
    let loss = |appearance: &GswAppearance, splat_embeddings: &[f32], colours: &[f32]| {
        let light = appearance.appearance_maps(0, draw);
        let shown = appearance.tint(
            0,
            light.as_ref(),
            &sight(&means, splat_embeddings, &radii, eye),
            colours.to_vec(),
        );
        let in_sight = |(k, (a, b)): (usize, (&f32, &f32))| f64::from(radii[k / 3] * a * b);
        shown.iter().zip(&grad).enumerate().map(in_sight).sum::<f64>()
    };
    let mut masked = grad.clone();
    masked.iter_mut().enumerate().for_each(|(k, g)| *g *= radii[k / 3]);
    let mut trained = appearance.clone();
    let light = appearance.appearance_maps(0, draw);
    let (colour_grads, embedding_grads) = trained.tint_backward(
        0,
        light.as_ref(),
        &sight(&means, &splat_embeddings, &radii, eye),
        &colours,
        masked.clone(),
        &[],
    );
    // Along the gradient of each group of parameters the loss rises by its square length.
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
    along("colours", &colour_grads, 1.0, &|s| {
        loss(&appearance, &splat_embeddings, &moved(&colours, &colour_grads, s))
    });
    let embedding_size = appearance.embedding_size();
    for (what, part) in [("intrinsic", 0..48), ("coordinates", 48..52), ("embed", 52..embedding_size)] {
        let mut own = embedding_grads.clone();
        let outside = |k: usize| !part.contains(&(k % embedding_size));
        own.iter_mut().enumerate().filter(|(k, _)| outside(*k)).for_each(|(_, g)| *g = 0.0);
        along(what, &own, 0.02, &|s| loss(&appearance, &moved(&splat_embeddings, &own, s), &colours));
    }
    // The networks: a step of Adam at a small rate goes down.
    (trained.net_rate, trained.point_rate) = (1e-5, 0.0);
    (trained.below.rate, trained.below.vector_rate) = (0.0, 0.0);
    let before = loss(&appearance, &splat_embeddings, &colours);
    let mut networks = trained.clone();
    networks.step(1.0);
    assert!(loss(&networks, &splat_embeddings, &colours) < before - 1e-3, "the UNet's step");
    (trained.net_rate, trained.point_rate) = (0.0, 1e-5);
    trained.step(1.0);
    assert!(loss(&trained, &splat_embeddings, &colours) < before - 1e-3, "the small networks' step");
    // Splats out of sight have no gradient.
    assert!(embedding_grads[3 * embedding_size..4 * embedding_size].iter().all(|g| *g == 0.0));
}

#[test]
fn gsw_appearance_embeddings_are_what_was_trained_and_can_be_baked() {
    let n = 700;
    let (appearance, means, _, pose) = conditioned(n);
    let splat_embeddings = appearance.first_embeddings(&means);
    let mut random = RasterTestRandom(13);
    let colours = random.many(3 * n, 0.0, 1.0);
    let eye = pose.centre();
    let radii = vec![1.0; n];
    let sight = VisibleSplats {
        means: &means,
        splat_embeddings: &splat_embeddings,
        radii: &radii,
        eye: eye.to_array(),
    };
    let direction = |i: usize| (glam::Vec3::from(means[i]) - eye).normalize().to_array();
    let mut appearance_embeddings = Vec::new();
    for view in 0..3 {
        let light = appearance.appearance_maps(view, None);
        assert_eq!(light.is_some(), view < 2, "the last one is without light");
        let trained = appearance.tint(view, light.as_ref(), &sight, colours.clone());
        let appearance_embedding = appearance.appearance_embedding(view, &means, &splat_embeddings);
        let shaded = appearance.shade(
            &appearance_embedding,
            &splat_embeddings,
            &|i| Some(direction(i)),
            colours.clone(),
        );
        let off = trained.iter().zip(&shaded).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 1e-4, "view {view}: {off}");
        appearance_embeddings.push(appearance_embedding);
    }
    assert!(
        appearance_embeddings[0] != appearance_embeddings[1]
            && appearance_embeddings[0] != appearance_embeddings[2]
    );
    // Strength 0 of a photo's light is no light.
    let light = appearance.appearance_maps(0, None).expect("seen");
    let below = appearance.below.appearance_embedding(2, &means, &splat_embeddings);
    let none = appearance.appearance_embedding_of(
        &[(&light, 0.0)],
        (&below, appearance.layer()),
        &means,
        &splat_embeddings,
    );
    assert_eq!(none, appearance.appearance_embedding(2, &means, &splat_embeddings));
    // In a file without a network: the colours that are nearest. The head is not a sum of harmonics, but smooth.
    let splats = Splats {
        means: means.clone(),
        log_scales: vec![[-3.0; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacities: vec![0.0; n],
        sh_degree: 1,
        sh: random.many(12 * n, -0.2, 0.2),
    };
    let baked = bake(&appearance, &appearance_embeddings[0], &splats, &splat_embeddings);
    let base = |sh: &[f32], i: usize, d: [f32; 3]| -> [f32; 3] {
        let h = [0.282_094_79, -0.488_602_5 * d[1], 0.488_602_5 * d[2], -0.488_602_5 * d[0]];
        std::array::from_fn(|c| 0.5 + (0..4).map(|k| h[k] * sh[12 * i + 3 * k + c]).sum::<f32>())
    };
    let own: Vec<f32> = (0..n).flat_map(|i| base(&splats.sh, i, direction(i))).collect();
    let wanted =
        appearance.shade(&appearance_embeddings[0], &splat_embeddings, &|i| Some(direction(i)), own.clone());
    let shown: Vec<f32> = (0..n).flat_map(|i| base(&baked.sh, i, direction(i))).collect();
    let apart = |a: &[f32], b: &[f32]| {
        (a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>() / a.len() as f32).sqrt()
    };
    let (with, without) = (apart(&shown, &wanted), apart(&own, &wanted));
    assert!(with < 0.1 * without, "baked {with}, not baked {without}");
}

#[test]
fn appearances_are_stored_and_read() {
    let mut appearance = AffineAppearance::new(3);
    appearance.set_matrix(2, [0.25; 12]);
    let gsw = GswAppearance::new(2, 1, GswWidth::Cpu);
    let others = [
        AnyAppearance::Embed(EmbedAppearance::new(2, 1)),
        AnyAppearance::Gsw(Box::new(gsw)),
        AnyAppearance::None(NoAppearance),
    ];
    for appearance in [AnyAppearance::Affine(appearance)].into_iter().chain(others) {
        let bytes = wincode::serialize(&appearance).expect("it is plain data");
        let read: AnyAppearance = wincode::deserialize(&bytes).expect("what was written");
        assert_eq!(read, appearance);
        assert_eq!(read.as_appearance().name(), appearance.as_appearance().name());
    }
}
