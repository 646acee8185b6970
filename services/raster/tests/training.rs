//! Optimiser and looks.

mod common;

use common::Random;
use segwild_raster::{Adam, AffineLook, AnyLook, EmbedLook, Look, NoLook, RANK};
use segwild_scene::Image;

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

#[test]
fn looks_are_stored_and_read() {
    let mut look = AffineLook::new(3);
    look.set_matrix(2, [0.25; 12]);
    for look in [AnyLook::Affine(look), AnyLook::Embed(EmbedLook::new(2, 1)), AnyLook::None(NoLook)] {
        let bytes = wincode::serialize(&look).expect("it is plain data");
        let read: AnyLook = wincode::deserialize(&bytes).expect("what was written");
        assert_eq!(read, look);
        assert_eq!(read.as_look().name(), look.as_look().name());
    }
}
