//! From proposals to a photo's masks.

use segwild_masks::{MaskError, MaskSettings, generate};
use segwild_scene::{Image, Mask, ScoredMask};
use segwild_vision::{MaskProposer, VisionError};
use std::sync::Mutex;

const W: u32 = 80;
const H: u32 = 60;

/// Proposes what a function says of each point, and remembers the sizes of the batches.
struct OracleProposer<F> {
    answer: F,
    batches: Mutex<Vec<usize>>,
}

impl<F: Fn([f32; 2]) -> Vec<ScoredMask> + Send + Sync> MaskProposer for OracleProposer<F> {
    fn key(&self) -> String {
        "oracle".into()
    }
    fn propose(&self, _: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError> {
        self.batches.lock().unwrap().push(points.len());
        if points.iter().any(|p| p[0] < 0.0) {
            return Err(VisionError::Image("point outside".into()));
        }
        Ok(points.iter().flat_map(|&p| (self.answer)(p)).collect())
    }
}

fn oracle<F: Fn([f32; 2]) -> Vec<ScoredMask> + Send + Sync>(answer: F) -> OracleProposer<F> {
    OracleProposer { answer, batches: Mutex::default() }
}

fn scored(mask: Mask, predicted_iou: f32, stability: f32) -> ScoredMask {
    ScoredMask { mask, predicted_iou, stability }
}

fn block(x0: u32, y0: u32, x1: u32, y1: u32) -> Mask {
    Mask::from_fn(W, H, |x, y| x >= x0 && x < x1 && y >= y0 && y < y1)
}

fn image() -> Image {
    Image::zeros(W as usize, H as usize, 3)
}

#[test]
fn filters_duplicates_and_order() {
    let good = block(0, 0, 40, 40);
    let shifted = block(1, 0, 41, 40); // IoU 0.95 with `good`
    let nested = block(0, 0, 20, 40); // IoU 0.5: a part, kept
    let proposals = vec![
        scored(good.clone(), 0.95, 0.99),
        scored(shifted.clone(), 0.99, 0.99),
        scored(nested.clone(), 0.90, 0.97),
        scored(block(60, 0, 80, 20), 0.87, 0.99), // predicted IoU too low
        scored(block(60, 20, 80, 40), 0.95, 0.94), // not stable
        scored(block(60, 40, 80, 60), f32::NAN, 0.99),
        scored(block(40, 40, 60, 60), 0.95, f32::NAN),
        scored(block(70, 50, 71, 51), 0.99, 0.99), // one pixel
        scored(Mask::empty(W, H), 0.99, 0.99),
    ];
    let strict = MaskSettings { min_masks: 0, ..MaskSettings::default() };
    let generated = generate(&oracle(|_| proposals.clone()), &image(), &[[1.0, 1.0]], None, &strict).unwrap();
    let kept: Vec<&Mask> = generated.set.masks.iter().map(|m| &m.mask).collect();
    assert_eq!(kept, [&shifted, &nested]);
    let t = generated.tally;
    assert_eq!((t.proposed, t.doubtful, t.unstable, t.duplicates, t.small, t.kept), (9, 2, 2, 1, 2, 2));
    assert_eq!((generated.set.width, generated.set.height), (W, H));
}

#[test]
fn the_suppression_agrees_with_iou_on_every_pair() {
    // Many overlapping blocks with scores in no order.
    let answer = |p: [f32; 2]| {
        let (x, y) = (p[0] as u32, p[1] as u32);
        let score = 0.88 + 0.001 * ((x * 37 + y * 61) % 100) as f32;
        vec![scored(block(x, y, x + 24 + y % 5, y + 18 + x % 7), score, 0.96)]
    };
    let points: Vec<[f32; 2]> = (0..300).map(|i| [(i % 30) as f32 * 2.0, (i / 30) as f32 * 4.0]).collect();
    let settings = MaskSettings { min_mask_area: 0.0, ..MaskSettings::default() };
    let oracle = oracle(answer);
    let kept = generate(&oracle, &image(), &points, None, &settings).unwrap().set.masks;
    assert!(kept.len() > 20 && kept.len() < 300, "{}", kept.len());
    for (i, a) in kept.iter().enumerate() {
        assert!(i == 0 || kept[i - 1].predicted_iou >= a.predicted_iou);
        assert!(kept[..i].iter().all(|b| a.mask.iou(&b.mask) <= f64::from(settings.mask_nms)));
    }
    // Whatever was dropped is nearly one that stayed and is no better than it.
    for m in points.iter().flat_map(|&p| answer(p)) {
        let limit = f64::from(settings.mask_nms);
        assert!(
            kept.iter()
                .any(|k| k.mask == m.mask
                    || (k.mask.iou(&m.mask) > limit && k.predicted_iou >= m.predicted_iou))
        );
    }
    // Batches bound memory and do not change the answer.
    let small = MaskSettings { prompt_batch: 7, ..settings };
    assert_eq!(generate(&oracle, &image(), &points, None, &small).unwrap().set.masks, kept);
    let batches = oracle.batches.lock().unwrap();
    assert_eq!(batches[..2], [256, 44]);
    assert!(batches[2..44].iter().all(|&n| n == 7) && batches[44..] == [6], "{batches:?}");
}

#[test]
fn the_most_stable_of_the_rest_fill_up() {
    let proposals = vec![
        scored(block(0, 0, 20, 20), 0.95, 0.40),
        scored(block(20, 0, 40, 20), 0.95, 0.99),
        scored(block(40, 0, 60, 20), 0.95, 0.60),
        scored(block(20, 0, 40, 19), 0.95, 0.90), // nearly the stable one
        scored(block(60, 0, 80, 20), 0.95, f32::NAN),
        scored(block(0, 40, 20, 60), 0.50, 0.90), // doubtful
        scored(block(20, 40, 40, 60), 0.95, 0.50),
    ];
    let with = |min_masks: u32| {
        let settings = MaskSettings { min_masks, ..MaskSettings::default() };
        generate(&oracle(|_| proposals.clone()), &image(), &[[1.0, 1.0]], None, &settings).unwrap()
    };
    let order = [1, 2, 6, 0];
    for n in 0..=6 {
        let made = with(n);
        let kept: Vec<&Mask> = made.set.masks.iter().map(|m| &m.mask).collect();
        let expected: Vec<&Mask> =
            order[..(n as usize).clamp(1, 4)].iter().map(|&k| &proposals[k].mask).collect();
        assert_eq!(kept, expected, "{n}");
        assert_eq!((made.tally.filled, made.tally.unstable), (kept.len() - 1, 6 - kept.len()));
    }
}

#[test]
fn the_sky_is_one_mask() {
    let sky = block(0, 0, 80, 20);
    let proposals = vec![
        scored(block(0, 0, 30, 18), 0.99, 0.99),   // a cloud
        scored(block(10, 15, 40, 50), 0.95, 0.99), // a tower that reaches into the sky
    ];
    let oracle = oracle(|_| proposals.clone());
    let on = MaskSettings::default();
    let with = generate(&oracle, &image(), &[[1.0, 1.0]], Some(&sky), &on).unwrap();
    let kept: Vec<&Mask> = with.set.masks.iter().map(|m| &m.mask).collect();
    assert_eq!(kept, [&proposals[1].mask, &sky]);
    assert_eq!(with.tally.sky, 1);
    let off = MaskSettings { sky_prompts: false, ..on.clone() };
    let without = generate(&oracle, &image(), &[[1.0, 1.0]], Some(&sky), &off).unwrap();
    assert_eq!(without, generate(&oracle, &image(), &[[1.0, 1.0]], None, &on).unwrap());
    // A sky found at half the size, and no sky at all.
    let half = sky.resized(40, 30);
    assert_eq!(generate(&oracle, &image(), &[[1.0, 1.0]], Some(&half), &on).unwrap(), with);
    let none = Mask::empty(W, H);
    assert_eq!(generate(&oracle, &image(), &[[1.0, 1.0]], Some(&none), &on).unwrap(), without);
}

#[test]
fn bad_masks_points_and_images_are_refused_with_a_sentence() {
    let settings = MaskSettings::default();
    let wrong = oracle(|_| vec![scored(Mask::full(5, 5), 1.0, 1.0)]);
    let error = generate(&wrong, &image(), &[[1.0, 1.0]], None, &settings).unwrap_err();
    assert!(error.to_string().contains("5x5") && error.to_string().contains("80x60"), "{error}");
    let error = generate(&wrong, &image(), &[[-1.0, 1.0]], None, &settings).unwrap_err();
    assert!(matches!(&error, MaskError::Provider { provider, .. } if provider == "oracle"), "{error}");
    assert!(error.to_string().contains("point outside"), "{error}");
    let hollow = Image { width: 4, height: 4, channels: 3, data: vec![] };
    assert!(matches!(generate(&wrong, &hollow, &[], None, &settings), Err(MaskError::Size(_))));
    let none = generate(&wrong, &image(), &[], None, &settings).unwrap();
    assert!(none.set.masks.is_empty());
}
