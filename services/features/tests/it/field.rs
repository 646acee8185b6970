//! Lifting and refinement on the CPU engine.

use crate::support::{cosine, noise, set};
use glam::Vec3;
use segwild_features::{
    Compression, FeatureColours, FeatureError, FeatureField, FeatureSettings, Lifted, Lifter, Pca, Progress,
    TargetSource, ViewTarget, WideFeatureField, build,
};
use segwild_objective::field::embedding_loss;
use segwild_raster::{Channels, CpuEngine, ProjectOptions, Rasterizer};
use segwild_scene::{Camera, Embedding, Image, Mask, Pose, Splats};
use std::ops::ControlFlow;
use std::sync::Arc;

const E: usize = 24;

/// Two cards beside each other in the plane z = 0 and a third hidden behind the first; `card[i]` of splat i.
struct Cards {
    splats: Splats,
    card: Vec<usize>,
    embeddings: Vec<Vec<f32>>,
}

fn cards(n: usize) -> Cards {
    let mut splats = Splats::default();
    let mut card = Vec::new();
    let mut random = noise(21);
    for (k, (x, z)) in [(-0.5, 0.0), (0.5, 0.0), (-0.5, 0.6)].into_iter().enumerate() {
        for j in 0..n {
            for i in 0..n {
                let (u, v) = ((i as f32 + 0.5) / n as f32 - 0.5, (j as f32 + 0.5) / n as f32 - 0.5);
                splats.means.push([x + 0.9 * u, 0.9 * v, z + 0.01 * random()]);
                splats.log_scales.push([(0.6 / n as f32).ln(); 3]);
                splats.rotations.push([1.0, 0.0, 0.0, 0.0]);
                splats.opacities.push(4.0);
                splats.sh.extend([0.0; 3]);
                card.push(k);
            }
        }
    }
    let embeddings = (0..3).map(|_| (0..E).map(|_| 5.0 * random()).collect()).collect();
    Cards { splats, card, embeddings }
}

fn camera() -> Camera {
    Camera { width: 96, height: 64, fx: 80.0, fy: 80.0, cx: 48.0, cy: 32.0 }
}

fn pose(k: usize) -> Pose {
    Pose::look_at(Vec3::new(0.1 * k as f32 - 0.2, 0.05 * k as f32, -2.0), Vec3::ZERO, Vec3::NEG_Y)
}

/// Which card each pixel shows from view `k`, by ray; `None` past the cards' edges.
fn seen(k: usize, x: f32, y: f32) -> Option<usize> {
    let pose = pose(k);
    let ray = pose.rotation.transpose() * camera().ray((x, y).into());
    let hit = pose.centre() - ray * (pose.centre().z / ray.z);
    let inside = |centre: f32| (hit.x - centre).abs() < 0.45 && hit.y.abs() < 0.45;
    if inside(-0.5) { Some(0) } else { inside(0.5).then_some(1) }
}

/// The embedding of view `k` on a grid of 24 x 16 cells: the card's embedding and noise.
fn embedding(cards: &Cards, k: usize, spread: f32) -> Embedding {
    let mut random = noise(100 + k as u32);
    let mut data = vec![0.0; 24 * 16 * E];
    for i in 0..24 * 16 {
        let card = seen(k, (i % 24) as f32 * 4.0 + 2.0, (i / 24) as f32 * 4.0 + 2.0);
        for c in 0..E {
            data[c * 384 + i] = card.map_or(1.0, |card| cards.embeddings[card][c]) + spread * random();
        }
    }
    Embedding { width: 24, height: 16, channels: E, data }
}

fn pca(cards: &Cards, channels: usize) -> Pca {
    let mut samples = segwild_features::EmbeddingSamples::new(5000, 4, 0);
    for k in 0..4 {
        samples.add(k, "view", &embedding(cards, k, 0.5), None, None).unwrap();
    }
    samples.fit(channels, 1.0).unwrap()
}

fn target(cards: &Cards, pca: &Pca, k: usize, compression: Compression) -> ViewTarget {
    let embedding = embedding(cards, k, 0.5);
    let target = match compression {
        Compression::Pca => pca.encode("view", &embedding).unwrap(),
        Compression::Learned => {
            let Embedding { width, height, channels, data } = embedding;
            Image { width, height, channels, data }
        }
    };
    let masks =
        (0..2).map(|c| Mask::from_fn(96, 64, |x, y| seen(k, x as f32 + 0.5, y as f32 + 0.5) == Some(c)));
    ViewTarget {
        name: format!("view{k}.jpg"),
        camera: camera(),
        pose: pose(k),
        target,
        validity: Image::filled(96, 64, 1, 1.0),
        masks: set(96, 64, masks.collect()),
    }
}

fn targets(cards: &Cards, pca: &Pca, compression: Compression) -> Vec<Arc<ViewTarget>> {
    (0..4).map(|k| Arc::new(target(cards, pca, k, compression))).collect()
}

fn settings(steps: u32) -> FeatureSettings {
    FeatureSettings {
        refine_steps: steps,
        feature_size: 48,
        pixels_per_step: 256,
        ..FeatureSettings::default()
    }
}

fn field(cards: &Cards, targets: &[Arc<ViewTarget>], pca: &Pca, settings: &FeatureSettings) -> FeatureField {
    try_field(cards, targets, pca, settings).unwrap()
}

fn try_field(
    cards: &Cards,
    targets: &[Arc<ViewTarget>],
    pca: &Pca,
    settings: &FeatureSettings,
) -> Result<FeatureField, FeatureError> {
    let engine = CpuEngine::new();
    let options = ProjectOptions::default();
    build(&engine, &cards.splats, &targets, pca, settings, &options, &mut |_| ControlFlow::Continue(()))
}

/// Mean feature of a card's splats.
fn mean(cards: &Cards, field: &FeatureField, card: usize) -> Vec<f32> {
    let of: Vec<usize> = (0..field.len()).filter(|&i| cards.card[i] == card).collect();
    (0..field.channels())
        .map(|k| of.iter().map(|&i| field.feature(i)[k]).sum::<f32>() / of.len() as f32)
        .collect()
}

#[test]
fn lifting_is_the_weighted_mean_of_what_each_splat_is_seen_in() {
    let cards = cards(12);
    let engine = CpuEngine::new();
    let mut lifter = Lifter::new(cards.splats.len(), 2);
    let (mut sums, mut weights) = (vec![0.0f64; cards.splats.len() * 2], vec![0.0f64; cards.splats.len()]);
    let mut random = noise(5);
    for k in 0..3 {
        let projected =
            engine.project(&cards.splats, &camera(), &pose(k), &ProjectOptions::default()).unwrap();
        let target = Image { data: (0..96 * 64 * 2).map(|_| random()).collect(), ..Image::zeros(96, 64, 2) };
        let validity =
            Image { data: (0..96 * 64).map(|_| random().max(0.0)).collect(), ..Image::zeros(96, 64, 1) };
        lifter.add("view", projected.as_ref(), &target, &validity).unwrap();
        // The weight of a splat at a pixel is what an indicator of that splat blends to there.
        for i in (0..cards.splats.len()).step_by(37) {
            let mut one = vec![0.0; cards.splats.len()];
            one[i] = 1.0;
            let share = projected.blend(&Channels { count: 1, values: &one }).unwrap().image;
            for p in 0..96 * 64 {
                let w = f64::from(share.data[p]) * f64::from(validity.data[p]);
                weights[i] += w;
                sums[2 * i] += w * f64::from(target.data[p]);
                sums[2 * i + 1] += w * f64::from(target.data[96 * 64 + p]);
            }
        }
    }
    let Lifted { values: features, weights: seen } = lifter.finish().unwrap();
    for i in (0..cards.splats.len()).step_by(37) {
        assert!((f64::from(seen[i]) - weights[i]).abs() < 1e-3 * weights[i] + 1e-4, "{i}");
        for c in 0..2 {
            let exact = if weights[i] > 1e-3 { sums[2 * i + c] / weights[i] } else { continue };
            assert!(
                (f64::from(features[2 * i + c]) - exact).abs() < 1e-3,
                "{i}: {} {exact}",
                features[2 * i + c]
            );
        }
    }
}

#[test]
fn lifted_features_tell_the_cards_apart_and_leave_geometry_alone() {
    let cards = cards(16);
    let before = cards.splats.clone();
    let pca = pca(&cards, 8);
    let field = field(&cards, &targets(&cards, &pca, Compression::Pca), &pca, &settings(0));
    let (a, b) = (mean(&cards, &field, 0), mean(&cards, &field, 1));
    assert!(cosine(&a, &b) < 0.5, "{}", cosine(&a, &b));
    let centre = (0..field.len()).filter(|&i| cards.card[i] == 0 && cards.splats.means[i][0].abs() < 0.7);
    for i in centre.filter(|&i| cards.splats.means[i][0] < -0.3 && cards.splats.means[i][1].abs() < 0.3) {
        assert!(cosine(&field.feature(i), &a) > 0.9, "{i}");
    }
    let lengths = field.inverse_lengths();
    assert!((0..field.len()).all(|i| {
        let length = field.feature(i).iter().map(|v| v * v).sum::<f32>().sqrt();
        if length > 0.0 { (lengths[i] * length - 1.0).abs() < 1e-4 } else { lengths[i] == 0.0 }
    }));
    // Refinement, too, only reads the splats.
    field_after(&cards, &pca, 5);
    assert_eq!(cards.splats, before);
}

fn field_after(cards: &Cards, pca: &Pca, steps: u32) -> FeatureField {
    field(cards, &targets(cards, pca, Compression::Pca), pca, &settings(steps))
}

#[test]
fn losses_reach_the_features_through_the_engine() {
    let cards = cards(6);
    let engine = CpuEngine::new();
    let projected = engine.project(&cards.splats, &camera(), &pose(0), &ProjectOptions::default()).unwrap();
    let (n, c) = (cards.splats.len(), 3);
    let mut random = noise(8);
    let values: Vec<f32> = (0..n * c).map(|_| random()).collect();
    // Far from the rendered values, so that no difference changes sign within a step.
    let target = Image {
        data: (0..96 * 64 * c).map(|i| if i % 2 == 0 { 9.0 } else { -9.0 }).collect(),
        ..Image::zeros(96, 64, c)
    };
    let validity: Vec<f32> = (0..96 * 64).map(|_| random().abs()).collect();
    let loss = |values: &[f32], grad: &mut Image| {
        let frame = projected.blend(&Channels { count: c, values }).unwrap();
        embedding_loss(&frame.image, (&target, 1.0), &validity, grad)
    };
    let mut grad = Image::zeros(96, 64, c);
    loss(&values, &mut grad);
    let slopes = projected.gather(&grad).unwrap();
    let mut scratch = Image::zeros(96, 64, c);
    for i in (0..n * c).step_by(29) {
        let at = |step: f32, scratch: &mut Image| {
            let mut moved = values.clone();
            moved[i] += step;
            f64::from(loss(&moved, scratch))
        };
        let slope = (at(4.0, &mut scratch) - at(-4.0, &mut scratch)) / 8.0;
        assert!(
            (slope - f64::from(slopes[i])).abs() < 1e-6 + 0.02 * slope.abs(),
            "{i}: {slope} {}",
            slopes[i]
        );
    }
}

#[test]
fn compactness_parts_what_the_embedding_cannot() {
    let cards = cards(16);
    let pca = pca(&cards, 8);
    // Every pixel has one and the same code: only the masks tell the cards apart.
    let alike: Vec<Arc<ViewTarget>> = targets(&cards, &pca, Compression::Pca)
        .iter()
        .map(|t| {
            let mut t = ViewTarget::clone(t);
            let mut random = noise(4);
            for c in 0..t.target.channels {
                let code = 0.3 + 0.05 * c as f32;
                t.target.plane_mut(c).iter_mut().for_each(|v| *v = code + 0.02 * random());
            }
            Arc::new(t)
        })
        .collect();
    let apart = |settings: &FeatureSettings| {
        let field = field(&cards, &alike, &pca, settings);
        let (a, b) = (mean(&cards, &field, 0), mean(&cards, &field, 1));
        let front = (0..field.len()).filter(|&i| cards.card[i] == 0);
        let near = front.filter(|&i| cosine(&field.feature(i), &a) > 0.95).count();
        (cosine(&a, &b), near as f64 / 256.0)
    };
    let strong = FeatureSettings { weight_embedding: 0.0, weight_compact: 1.0, ..settings(500) };
    let (across, near) = apart(&strong);
    assert!(across < 0.05 && near > 0.85, "across {across}, near {near}");
    let (across, _) = apart(&FeatureSettings { compactness: false, ..settings(100) });
    assert!(across > 0.95, "without compactness nothing parts them: {across}");
    // Without masks there is nothing to compare, and that is no error.
    let bare: Vec<_> = alike
        .iter()
        .map(|t| Arc::new(ViewTarget { masks: set(96, 64, vec![]), ..ViewTarget::clone(t) }))
        .collect();
    assert_eq!(
        field(&cards, &bare, &pca, &settings(20)),
        field(&cards, &alike, &pca, &FeatureSettings { compactness: false, ..settings(20) })
    );
}

#[test]
fn both_losses_fall_and_a_person_can_stop() {
    let cards = cards(16);
    let pca = pca(&cards, 8);
    let targets = targets(&cards, &pca, Compression::Pca);
    let engine = CpuEngine::new();
    let (mut reported, mut lifted, mut refined) = (Vec::new(), 0, 0);
    let mut listen = |progress: Progress| {
        match progress {
            Progress::Lifted { done, of } => {
                lifted += 1;
                assert_eq!((done, of), (lifted, 4));
            }
            Progress::Refined { done, of, losses } => {
                refined += 1;
                assert_eq!((done, of, losses.is_some()), (refined, 500, done == 1 || done % 20 == 0));
                reported.extend(losses);
            }
        }
        if refined == 120 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    build(
        &engine,
        &cards.splats,
        &&targets[..],
        &pca,
        &settings(500),
        &ProjectOptions::default(),
        &mut listen,
    )
    .unwrap();
    assert_eq!((lifted, refined), (4, 120));
    let (first, last) = (reported[0], reported[reported.len() - 1]);
    assert!(last.embedding < first.embedding && last.compact < first.compact, "{reported:?}");
}

#[test]
fn the_same_bytes_whatever_threads_and_memory() {
    let cards = cards(12);
    let pca = pca(&cards, 8);
    let targets = targets(&cards, &pca, Compression::Pca);
    let run = |threads: usize, memory: u32| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let settings = FeatureSettings { feature_memory: memory, ..settings(30) };
        pool.install(|| wincode::serialize(&field(&cards, &targets, &pca, &settings)).unwrap())
    };
    let bytes = run(1, 512);
    assert!(bytes == run(4, 512), "threads change the field");
    assert!(bytes == run(3, 0), "views computed again change the field");
    let back: FeatureField = wincode::deserialize(&bytes).unwrap();
    assert_eq!(wincode::serialize(&back).unwrap(), bytes);
    let other = FeatureSettings { feature_seed: 1, ..settings(30) };
    assert!(bytes != wincode::serialize(&field(&cards, &targets, &pca, &other)).unwrap(), "the seed is used");
}

#[test]
fn a_field_of_32_bits_is_rounded_and_one_whose_parts_do_not_fit_is_refused() {
    let cards = cards(6);
    let pca = pca(&cards, 3);
    let values: Vec<f32> = (0..120).map(|i| ((i * 37 % 101) as f32 - 50.0) * 1e-2).collect();
    let wide = |channels: usize, values: &[f32]| WideFeatureField {
        channels,
        values: values.to_vec(),
        pca: pca.clone(),
        decoder: pca.decoder(),
    };
    let field = FeatureField::try_from(wide(3, &values)).unwrap();
    assert_eq!((field.channels(), field.len()), (3, 40));
    assert!(field.values().iter().zip(&values).all(|(a, b)| (a - b).abs() <= b.abs() / 2048.0));
    field.check().unwrap();
    // What was rounded is not rounded again.
    assert_eq!(FeatureField::try_from(wide(3, &field.values())).unwrap(), field);
    for channels in [0, 7, usize::MAX] {
        assert!(FeatureField::try_from(wide(channels, &values)).is_err(), "{channels}");
    }
    let other = FeatureField::try_from(wide(4, &values)).unwrap();
    assert!(other.check().is_err(), "four channels, and a decoder of three");
    // A splat with a number that is none has no feature.
    let spoiled = [&values[..4], &[f32::NAN], &values[5..]].concat();
    let field = FeatureField::try_from(wide(3, &spoiled)).unwrap();
    assert_eq!(field.feature(1), [0.0; 3]);
    assert_eq!((field.inverse_lengths()[1], field.feature(0).len()), (0.0, 3));
}

#[test]
fn the_learned_decoder_serves_as_well() {
    let cards = cards(12);
    let pca = pca(&cards, 8);
    let learned = FeatureSettings { compression: Compression::Learned, ..settings(60) };
    let a = field(&cards, &targets(&cards, &pca, Compression::Learned), &pca, &learned);
    let b = field_after(&cards, &pca, 60);
    let apart = |f: &FeatureField| cosine(&mean(&cards, f, 0), &mean(&cards, f, 1));
    assert!((apart(&a) - apart(&b)).abs() < 0.2, "{} {}", apart(&a), apart(&b));
    assert_ne!(a.decoder, pca.decoder());
    assert_eq!(b.decoder, pca.decoder());
    // Decoded, a card's feature is near the code it was made from.
    let code = Image { width: 1, height: 1, channels: 8, data: mean(&cards, &a, 1) };
    let decoded = a.decoder.decode(&code).unwrap();
    let centred = |v: &[f32]| -> Vec<f32> { v.iter().zip(&pca.mean).map(|(v, m)| v - m).collect() };
    assert!(cosine(&centred(&decoded.data), &centred(&cards.embeddings[1])) > 0.9);
}

#[test]
fn poison_is_refused_by_name_or_has_no_part() {
    let cards = cards(8);
    let pca = pca(&cards, 4);
    let good = targets(&cards, &pca, Compression::Pca);
    let with = |change: &dyn Fn(&mut ViewTarget)| {
        let mut targets = good.clone();
        change(Arc::make_mut(&mut targets[2]));
        try_field(&cards, &targets, &pca, &settings(8))
    };
    let refused = |change: &dyn Fn(&mut ViewTarget)| {
        let error = with(change).unwrap_err().to_string();
        assert!(error.contains("view2.jpg"), "{error}");
        error
    };
    assert!(refused(&|t| t.target.data[30] = f32::NAN).contains("NaN in channel 0 at cell (6, 1)"));
    assert!(refused(&|t| t.validity.data[5] = f32::INFINITY).contains("validity"));
    assert!(refused(&|t| t.target = Image::zeros(24, 16, 3)).contains("3 channels"));
    assert!(refused(&|t| t.target.data.truncate(7)).contains("7 values"));
    assert!(refused(&|t| t.camera.width = 0).contains("no pixels"));
    assert!(refused(&|t| t.masks.masks[0].mask = Mask::empty(3, 3)).contains("3x3"));

    let finite = |f: &FeatureField| f.values().iter().all(|v| v.is_finite());
    // All-zero masks, no masks, masks over everything, a photo nothing of which is trusted, tiny targets.
    assert!(finite(&with(&|t| t.masks = set(96, 64, vec![Mask::empty(96, 64); 3])).unwrap()));
    assert!(finite(&with(&|t| t.masks = set(0, 0, vec![])).unwrap()));
    assert!(finite(&with(&|t| t.masks = set(96, 64, vec![Mask::full(96, 64); 2])).unwrap()));
    assert!(finite(&with(&|t| t.validity = Image::zeros(5, 5, 1)).unwrap()));
    assert!(finite(&with(&|t| t.target = Image::zeros(1, 1, 4)).unwrap()));
    let dark: Vec<_> = good
        .iter()
        .map(|t| Arc::new(ViewTarget { validity: Image::zeros(1, 1, 1), ..ViewTarget::clone(t) }))
        .collect();
    assert!(
        field(&cards, &dark, &pca, &settings(8)).values().iter().all(|&v| v == 0.0),
        "distrusted everywhere: nothing is learnt"
    );
    assert!(field(&cards, &[], &pca, &settings(8)).values().iter().all(|&v| v == 0.0), "no photo");
    let none = Cards { splats: Splats::default(), card: vec![], embeddings: vec![] };
    assert!(field(&none, &good, &pca, &settings(8)).is_empty(), "no splat");

    // Splats that no engine can draw do not spoil the others.
    let mut ill = cards_with_poison(&cards);
    let field = field(&ill, &good, &pca, &settings(8));
    assert!(finite(&field));
    ill.splats.means.truncate(1);
    assert!(try_field(&ill, &good, &pca, &settings(8)).is_err(), "arrays of two lengths");
}

fn cards_with_poison(cards: &Cards) -> Cards {
    let mut splats = cards.splats.clone();
    splats.means[3] = [f32::NAN; 3];
    splats.log_scales[5] = [90.0; 3];
    splats.rotations[7] = [0.0; 4];
    splats.opacities[9] = f32::INFINITY;
    Cards { splats, card: cards.card.clone(), embeddings: cards.embeddings.clone() }
}

#[test]
fn the_source_loads_one_view_at_a_time() {
    struct Late<'a>(&'a [Arc<ViewTarget>]);
    impl TargetSource for Late<'_> {
        fn len(&self) -> usize {
            self.0.len() + 1
        }
        fn load(&self, view: usize) -> Result<Arc<ViewTarget>, FeatureError> {
            let missing = || FeatureError::Source { name: "late.jpg".into(), reason: "never came".into() };
            self.0.get(view).cloned().ok_or_else(missing)
        }
    }
    let cards = cards(8);
    let pca = pca(&cards, 4);
    let targets = targets(&cards, &pca, Compression::Pca);
    let engine = CpuEngine::new();
    let mut done = 0;
    let result = build(
        &engine,
        &cards.splats,
        &Late(&targets),
        &pca,
        &settings(1),
        &ProjectOptions::default(),
        &mut |_| {
            done += 1;
            ControlFlow::Continue(())
        },
    );
    assert_eq!(result.unwrap_err().to_string(), "late.jpg: never came");
    assert_eq!(done, 4, "the views before it were lifted");
}

#[test]
fn different_features_have_different_colours() {
    let cards = cards(16);
    let pca = pca(&cards, 8);
    let field = field_after(&cards, &pca, 0);
    let engine = CpuEngine::new();
    let projected = engine.project(&cards.splats, &camera(), &pose(1), &ProjectOptions::default()).unwrap();
    let frame = projected.blend_resident(&field.resident_channels()).unwrap();
    let colours = FeatureColours::of(&field).unwrap().paint(&frame);
    assert_eq!((colours.width, colours.height, colours.channels), (96, 64, 3));
    assert!(colours.data.iter().all(|v| (0.0..=1.0).contains(v)));
    let at = |x: usize| -> [f32; 3] { std::array::from_fn(|c| colours.at(c, x, 32)) };
    let far = |a: [f32; 3], b: [f32; 3]| a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let (left, right) = if seen(1, 30.0, 32.0) == Some(0) { (30, 66) } else { (66, 30) };
    assert!(far(at(left), at(right)) > 0.5, "{:?} {:?}", at(left), at(right));
    assert_eq!(std::array::from_fn(|c| colours.at(c, 0, 0)), [0.0; 3], "nothing there");
    // One feature everywhere, or none, is grey or black, not an error.
    let of = |value: f32| {
        let values = vec![value; field.len() * field.channels()];
        FeatureField::rounded(field.channels(), &values, pca.clone(), pca.decoder()).unwrap()
    };
    let flat = of(0.5);
    let frame = projected.blend_resident(&flat.resident_channels()).unwrap();
    assert_eq!(FeatureColours::of(&flat).unwrap().paint(&frame).at(0, 30, 32), 0.5);
    let zero = of(0.0);
    let frame = projected.blend_resident(&zero.resident_channels()).unwrap();
    assert!(FeatureColours::of(&zero).unwrap().paint(&frame).data.iter().all(|&v| v == 0.0));
}
