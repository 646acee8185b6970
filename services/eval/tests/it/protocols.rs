//! Metrics, tables, perturbations and the oracle.

use segwild_eval::metrics::{Half, Spread, label_iou, leakage, psnr, score, ssim};
use segwild_eval::oracle::{Oracle, OracleOptions};
use segwild_eval::perturb::{AffineColours, SQUARE, StripedSquare, lego};
use segwild_eval::protocols::tables::perturbations;
use segwild_eval::record::{Record, Results};
use segwild_eval::table::ScoreTable;
use segwild_scene::{BoxPrompt, Image, Mask, PointPrompt, Prompts};
use segwild_synthetic::{SyntheticOptions, SyntheticScene, generate};
use segwild_vision::{Embedder, MaskProposer, PromptSegmenter, SkyDetector};
use std::sync::OnceLock;

fn scene() -> &'static SyntheticScene {
    static SCENE: OnceLock<SyntheticScene> = OnceLock::new();
    SCENE.get_or_init(|| {
        generate(&SyntheticOptions {
            seed: 4,
            train: 10,
            test: 2,
            long_side: 160,
            occlusion: 0.1,
            points: 0,
            ..Default::default()
        })
        .unwrap()
    })
}

fn ramp(width: usize, height: usize) -> Image {
    let mut image = Image::zeros(width, height, 3);
    for (i, v) in image.data.iter_mut().enumerate() {
        *v = ((i * 7919) % 101) as f32 / 100.0;
    }
    image
}

#[test]
fn psnr_and_ssim_are_their_definitions() {
    let truth = ramp(23, 17);
    let mut off = truth.clone();
    off.data.iter_mut().for_each(|v| *v += 0.1);
    assert!((psnr(&off, &truth, None).unwrap() - 20.0).abs() < 1e-4);
    assert_eq!(psnr(&truth, &truth, None).unwrap(), f64::INFINITY);
    assert!((ssim(&truth, &truth, None).unwrap() - 1.0).abs() < 1e-9);
    assert!(psnr(&truth, &ramp(17, 23), None).is_err());
    assert!(psnr(&truth, &truth, Some(&Mask::empty(23, 17))).is_err());
    off.data[0] = f32::NAN;
    assert!(psnr(&off, &truth, None).unwrap().is_nan());

    // One window, straight from the formula: a 1 x 1 image has one tap of weight w = g(0)^2.
    let (a, b) = (Image::filled(1, 1, 1, 0.8), Image::filled(1, 1, 1, 0.3));
    let total: f64 = (-5..=5).map(|k: i32| (-f64::from(k * k) / 4.5).exp()).sum();
    let w = 1.0 / (total * total);
    let (ma, mb) = (0.8 * w, 0.3 * w);
    let (va, vb, cov) = (0.64 * w - ma * ma, 0.09 * w - mb * mb, 0.24 * w - ma * mb);
    let want = (2.0 * ma * mb + 1e-4) * (2.0 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
    assert!((ssim(&a, &b, None).unwrap() - want).abs() < 1e-6);
}

#[test]
fn masks_are_scored_without_transients() {
    let truth = Mask::from_fn(40, 30, |x, _| x < 20);
    let mask = Mask::from_fn(40, 30, |x, _| x < 10);
    let plain = score(&mask, &truth, None).unwrap();
    assert!((plain.iou - 0.5).abs() < 1e-12 && (plain.accuracy - 0.75).abs() < 1e-12);
    assert!(plain.boundary_iou < plain.iou);
    let transients = Mask::from_fn(40, 30, |x, _| (10..20).contains(&x));
    let fair = score(&mask, &truth, Some(&transients)).unwrap();
    assert_eq!((fair.iou, fair.accuracy, fair.boundary_iou), (1.0, 1.0, 1.0));
    assert!(score(&mask, &Mask::empty(30, 40), None).is_err());
    assert!(score(&mask, &truth, Some(&Mask::full(40, 30))).is_err());
}

#[test]
fn spreads_tables_halves_and_labels() {
    let s = Spread::of(&[1.0, 2.0, 3.0, 4.0]).unwrap();
    assert_eq!((s.mean, s.least, s.most, s.count), (2.5, 1.0, 4.0, 4));
    assert!((s.deviation - (5.0f64 / 3.0).sqrt()).abs() < 1e-12);
    assert!(Spread::of(&[]).is_none());

    let (all, none) = (Mask::full(8, 8), Mask::empty(8, 8));
    let (right, wrong) = (score(&all, &all, None).unwrap(), score(&none, &all, None).unwrap());
    let mut table = ScoreTable::default();
    for photo in ["a", "b", "c"] {
        table.push("dome", photo, right);
    }
    table.push("lintel", "a", wrong);
    // Objects count alike, however many photos they are in.
    assert_eq!(table.mean(|s| s.iou).unwrap().mean, 0.5);
    assert!(
        table.markdown().contains("| dome | 3 | 1.000 | 1.000 | 1.000 | 1.000 |"),
        "{}",
        table.markdown()
    );

    let image = ramp(7, 4);
    let (left, rest) = (Half::Left.of(&image), Half::Right.of(&image));
    assert_eq!((left.width, rest.width), (3, 4));
    assert_eq!((left.at(2, 1, 3), rest.at(1, 0, 2)), (image.at(2, 1, 3), image.at(1, 3, 2)));
    assert_eq!(Half::Left.mask(7, 4).count() + Half::Right.mask(7, 4).count(), 28);

    let labels = [1, 1, 2, 3];
    let chosen = [true, false, true, false];
    assert!((label_iou(&chosen, &labels, 1, |_| 1.0) - 1.0 / 3.0).abs() < 1e-12);
    assert!((label_iou(&chosen, &labels, 1, |i| [6.0, 1.0, 1.0, 9.0][i]) - 0.75).abs() < 1e-12);
    assert_eq!(
        (leakage(&chosen, &labels, 2), leakage(&chosen, &labels, 3), leakage(&chosen, &labels, 9)),
        (1.0, 0.0, 0.0)
    );
}

#[test]
fn a_row_states_the_share_it_recovers_of_gaps_and_of_the_way_to_its_clean_photos() {
    let record = |setting: &str, target: &str, psnr: f64, clean: f64| Record {
        setting: setting.into(),
        target: target.into(),
        numbers: [("psnr".to_owned(), psnr), ("gap_db".to_owned(), clean - psnr)].into(),
        ..Record::default()
    };
    let mut results = Results::default();
    for (setting, clean, occluded) in [("plain", 22.0, 20.0), ("full", 24.0, 23.5)] {
        results.records.push(record(setting, "clean", clean, clean));
        results.records.push(record(setting, "occluders", occluded, clean));
    }
    let text = perturbations(&results);
    // Half a dB lost for two; and 3.5 of the 4 dB from the occluded plain splats to its own clean ones.
    assert!(text.contains("| full | – | –, – | 75 %, 88 % | –, – |"), "{text}");
    results.records.retain(|r| r.setting == "full");
    assert!(!perturbations(&results).contains('%'), "there is nothing to compare with");
}

#[test]
fn lego_is_perturbed_as_published() {
    let image = Image::filled(800, 800, 3, 0.5);
    let (photo, square) = lego(&image, 3, 14).unwrap();
    assert_eq!(square.count(), SQUARE * SQUARE);
    let rule = AffineColours::random(3, 14);
    for c in 0..3 {
        assert!((0.8..=1.2).contains(&rule.scale[c]) && (-0.2..=0.2).contains(&rule.shift[c]));
        let want = (0.5 * rule.scale[c] + rule.shift[c]).clamp(0.0, 1.0);
        let outside = (0..800 * 800).filter(|&i| !square.index(i));
        assert!(outside.into_iter().all(|i| photo.plane(c)[i] == want));
    }
    let at = StripedSquare::random(3, 14, 800, 800).unwrap();
    let row = |x: usize| [0, 1, 2].map(|c| photo.at(c, at.left + x, at.top + 50));
    for stripe in 0..10 {
        assert_eq!(row(stripe * 20), row(stripe * 20 + 19));
        assert_eq!(row(stripe * 20), at.stripes[stripe]);
    }
    assert_ne!(row(0), row(20));
    let small = lego(&Image::filled(199, 800, 3, 0.5), 3, 14).unwrap_err().to_string();
    assert!(small.contains("199x800"), "{small}");
    assert!(lego(&Image::filled(800, 800, 1, 0.5), 3, 14).is_err());
}

#[test]
fn a_perfect_oracle_knows_photos_clean_views_and_renders() {
    let scene = scene();
    let oracle = Oracle::new(scene, OracleOptions::perfect());
    for photo in &scene.photos {
        assert_eq!(oracle.sky(&photo.clean).unwrap(), photo.sky());
        assert_eq!(oracle.sky(&photo.photo).unwrap(), photo.sky().minus(&photo.transients));
        // A blurred, darker, half-size image stands for a render of the view.
        let (w, h) = (photo.clean.width, photo.clean.height);
        let mut render = photo.clean.resized(w / 4, h / 4).resized(w / 2, h / 2);
        render.data.iter_mut().for_each(|v| *v = *v * 0.7 + 0.05);
        let sky = oracle.sky(&render).unwrap();
        let want = photo.sky().resized(sky.width(), sky.height());
        assert!(sky.iou(&want) > 0.98, "{}: {}", photo.name, sky.iou(&want));
    }
    for object in scene.objects() {
        let Some(click) = scene.clicks(object).into_iter().next() else { continue };
        let photo = scene.photos.iter().find(|p| p.name == click.photo).unwrap();
        let seen = photo.mask(object).minus(&photo.transients);
        let found = oracle.segment(&photo.photo, &Prompts::click(click.x, click.y)).unwrap();
        assert_eq!(found.mask, seen);
        let fine = Prompts { granularity: Some(0.0), ..Prompts::click(click.x, click.y) };
        let part = oracle.segment(&photo.photo, &fine).unwrap().mask;
        assert!(part.minus(&seen).is_empty() && part.at(click.x, click.y));
        let masks = oracle.propose(&photo.photo, &[[click.x, click.y]]).unwrap();
        assert!(masks.iter().any(|m| m.mask == seen) && masks.iter().any(|m| m.mask == part));
        // A rough selection snaps to the object.
        let certainty = Image {
            width: photo.photo.width,
            height: photo.photo.height,
            channels: 1,
            data: (0..photo.depth.len())
                .map(|i| if photo.mask(object).index(i) { 0.8 } else { 0.1 })
                .collect(),
        };
        assert_eq!(oracle.refine(&photo.clean, &certainty).unwrap().mask, photo.mask(object));
    }
    let stripes = ramp(160, 120);
    assert!(oracle.sky(&stripes).unwrap_err().to_string().contains("160x120"));
    assert!(oracle.sky(&Image::zeros(160, 120, 1)).is_err());
}

#[test]
fn boxes_and_negative_clicks_mean_what_they_say() {
    let scene = scene();
    let oracle = Oracle::new(scene, OracleOptions::perfect());
    let dome = scene.instance_named("dome").unwrap();
    let lintel = scene.instance_named("lintel").unwrap();
    let photo = scene.photos.iter().find(|p| p.click(dome).is_some() && p.click(lintel).is_some()).unwrap();
    let (mut b, seen) = ([f32::MAX, f32::MAX, 0.0f32, 0.0f32], photo.mask(dome));
    for (x, y) in seen.pixels() {
        b = [b[0].min(x as f32), b[1].min(y as f32), b[2].max(x as f32 + 1.0), b[3].max(y as f32 + 1.0)];
    }
    let boxed =
        Prompts { boxes: vec![BoxPrompt { x0: b[2], y0: b[1], x1: b[0], y1: b[3] }], ..Prompts::default() };
    assert_eq!(oracle.segment(&photo.clean, &boxed).unwrap().mask, seen);

    let [dx, dy] = photo.click(dome).unwrap();
    let [lx, ly] = photo.click(lintel).unwrap();
    let point = |x, y, inside| PointPrompt { x, y, inside };
    let both = Prompts { points: vec![point(dx, dy, true), point(lx, ly, true)], ..Prompts::default() };
    assert_eq!(oracle.segment(&photo.clean, &both).unwrap().mask, seen.or(&photo.mask(lintel)));
    let one = Prompts { points: vec![point(dx, dy, true), point(lx, ly, false)], ..Prompts::default() };
    assert_eq!(oracle.segment(&photo.clean, &one).unwrap().mask, seen);
    assert!(oracle.segment(&photo.clean, &Prompts::default()).is_err());
}

#[test]
fn faults_are_as_large_as_requested_and_always_the_same() {
    let scene = scene();
    let faulty = Oracle::new(scene, OracleOptions { merge: 0.0, ..OracleOptions::default() });
    let perfect = Oracle::new(scene, OracleOptions::perfect());
    let (mut requested, mut given, mut moved) = (0, 0, 0);
    for photo in &scene.photos {
        let points: Vec<[f32; 2]> =
            (1..scene.instances.len() as u16).filter_map(|id| photo.click(id)).collect();
        let masks = faulty.propose(&photo.clean, &points).unwrap();
        assert_eq!(masks, faulty.propose(&photo.clean, &points).unwrap());
        let exact = perfect.propose(&photo.clean, &points).unwrap();
        requested += exact.len();
        given += masks.len();
        for m in &masks {
            let fits = |e: &Mask| {
                m.mask.minus(&e.dilated(5.0)).is_empty() && e.eroded(5.0).minus(&m.mask).is_empty()
            };
            assert!(exact.iter().any(|e| fits(&e.mask)));
            moved += usize::from(!exact.iter().any(|e| e.mask == m.mask));
        }
    }
    let dropped = 1.0 - given as f64 / requested as f64;
    assert!((0.04..0.17).contains(&dropped), "{dropped} of {requested}");
    assert!(moved * 2 > given, "{moved} of {given}");

    let merging = Oracle::new(scene, OracleOptions { merge: 1.0, ..OracleOptions::perfect() });
    let photo = &scene.photos[0];
    let click = photo.click(1).unwrap();
    let alone = perfect.propose(&photo.clean, &[click]).unwrap();
    let grown = merging.propose(&photo.clean, &[click]).unwrap();
    assert!(grown[0].mask.count() > alone[0].mask.count() && alone[0].mask.minus(&grown[0].mask).is_empty());
}

/// Cosines of embeddings of the dome and the lintel over all photos: of one with itself, and with the other.
fn alike(options: OracleOptions) -> (Spread, Spread) {
    let scene = scene();
    let oracle = Oracle::new(scene, options);
    let object = |name: &str| scene.instance_named(name).unwrap();
    let (dome, lintel) = (object("dome"), object("lintel"));
    let mut cells: Vec<(u16, Vec<f32>)> = Vec::new();
    for photo in &scene.photos {
        let e = oracle.embed(&photo.photo).unwrap();
        assert_eq!((e.channels, e.width.max(e.height), e.data.len()), (64, 64, 64 * e.width * e.height));
        for id in [dome, lintel] {
            let Some([x, y]) = photo.click(id) else { continue };
            let (cx, cy) = (
                (x / photo.photo.width as f32 * e.width as f32) as usize,
                (y / photo.photo.height as f32 * e.height as f32) as usize,
            );
            let code = (0..e.channels).map(|c| e.data[(c * e.height + cy) * e.width + cx]).collect();
            cells.push((id, code));
        }
    }
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>();
    let cosine = |a: &[f32], b: &[f32]| dot(a, b) / (dot(a, a) * dot(b, b)).sqrt();
    let (mut same, mut other) = (Vec::new(), Vec::new());
    for (i, a) in cells.iter().enumerate() {
        for b in &cells[..i] {
            if a.0 == b.0 {
                same.push(f64::from(cosine(&a.1, &b.1)))
            } else {
                other.push(f64::from(cosine(&a.1, &b.1)))
            }
        }
    }
    (Spread::of(&same).unwrap(), Spread::of(&other).unwrap())
}

#[test]
fn embeddings_tell_instances_apart_across_photos() {
    let (same, other) = alike(OracleOptions::default());
    assert!(same.least > other.most + 0.1, "{same} against {other}");
    assert!(same.most < 0.9999, "{same}");
    // Built things that are kin are alike, and still not the same.
    let kin = OracleOptions { embedding_similarity: 0.9, part_code: 0.0, ..OracleOptions::perfect() };
    let (same, other) = alike(kin);
    assert!((other.mean - 0.9).abs() < 0.05 && other.mean < same.mean - 0.05, "{same} against {other}");
}
