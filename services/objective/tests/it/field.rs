//! The compactness loss against an f64 reference, central differences and the toy image of the method.

use segwild_objective::field::{Membership, RowAdam, compactness};
use segwild_scene::{Mask, MaskSet, Random, ScoredMask};

/// Numbers in [-1, 1).
fn noise(seed: u64) -> impl FnMut() -> f32 {
    let mut random = Random::new(seed);
    move || 2.0 * random.uniform() - 1.0
}

/// Masks with full scores.
fn set(width: u32, height: u32, masks: Vec<Mask>) -> MaskSet {
    let masks =
        masks.into_iter().map(|mask| ScoredMask { mask, predicted_iou: 1.0, stability: 1.0 }).collect();
    MaskSet { width, height, masks }
}

/// The columns `from..to`.
fn columns(width: u32, height: u32, from: u32, to: u32) -> Mask {
    Mask::from_fn(width, height, |x, _| x >= from && x < to)
}

/// Cosine of two vectors.
fn cosine(a: &[f32], b: &[f32]) -> f64 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum::<f64>();
    dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
}

/// The loss as the method states it, pair by pair in f64.
fn reference(features: &[f64], c: usize, groups: &[u32], sets: &[Vec<u32>]) -> f64 {
    let (mut near, mut far, mut near_n, mut far_n) = (0.0, 0.0, 0.0f64, 0.0f64);
    for p in 0..groups.len() {
        for q in 0..groups.len() {
            if p == q || groups[p] == Membership::NONE || groups[q] == Membership::NONE {
                continue;
            }
            let (f, g) = (&features[p * c..(p + 1) * c], &features[q * c..(q + 1) * c]);
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
            let cos = (dot(f, g) / (dot(f, f) * dot(g, g)).sqrt()).max(0.0);
            let (a, b) = (&sets[groups[p] as usize], &sets[groups[q] as usize]);
            let both = a.iter().filter(|m| b.contains(m)).count() as f64;
            let s = both / ((a.len() + b.len()) as f64 - both + 1e-5);
            if s > 0.0 {
                near -= s * cos;
                near_n += 1.0;
            } else {
                far += cos;
                far_n += 1.0;
            }
        }
    }
    near / near_n.max(1.0) + far / far_n.max(1.0)
}

/// Overlapping and nested masks with pixels in none.
fn tangle() -> Membership {
    let masks = vec![
        columns(16, 4, 0, 6),
        columns(16, 4, 2, 4),
        columns(16, 4, 5, 9),
        columns(16, 4, 11, 15),
        Mask::empty(16, 4),
        Mask::from_fn(16, 4, |x, y| x >= 11 && y > 1),
    ];
    Membership::new(&set(16, 4, masks), 16, 4)
}

#[test]
fn loss_and_gradient_agree_with_f64() {
    let membership = tangle();
    let (n, c) = (64, 5);
    let mut random = noise(3);
    let features: Vec<f32> = (0..n * c).map(|_| random() + 0.3).collect();
    let mut grad = vec![f32::NAN; n * c];
    let result = compactness(&features, c, &membership.groups, &membership, &mut grad);
    let start: Vec<f64> = features.iter().map(|&v| f64::from(v)).collect();
    let at = |f: &[f64]| reference(f, c, &membership.groups, &membership.sets);
    assert!((f64::from(result.loss) - at(&start)).abs() < 1e-6, "{result:?} {}", at(&start));
    assert!((0.0..=1.0).contains(&result.within) && (0.0..=1.0).contains(&result.across));
    for i in 0..n * c {
        let (mut up, mut down) = (start.clone(), start.clone());
        up[i] += 1e-6;
        down[i] -= 1e-6;
        let slope = (at(&up) - at(&down)) / 2e-6;
        assert!((slope - f64::from(grad[i])).abs() < 1e-6, "{i}: {slope} {}", grad[i]);
    }
    let outside = membership.groups.iter().position(|&g| g == Membership::NONE).unwrap();
    assert_eq!(grad[outside * c..(outside + 1) * c], vec![0.0; c]);
}

#[test]
fn only_directions_matter() {
    let membership = tangle();
    let mut random = noise(4);
    let features: Vec<f32> = (0..64 * 3).map(|_| random()).collect();
    let doubled: Vec<f32> = features.iter().map(|v| v * 2.0).collect();
    let (mut a, mut b) = (vec![0.0; 192], vec![0.0; 192]);
    let first = compactness(&features, 3, &membership.groups, &membership, &mut a);
    assert_eq!(first, compactness(&doubled, 3, &membership.groups, &membership, &mut b));
    assert!(a.iter().zip(&b).all(|(a, b)| (a - 2.0 * b).abs() <= 1e-6 * a.abs()));
}

#[test]
fn nested_masks_are_half_alike() {
    let membership = Membership::new(&set(4, 1, vec![columns(4, 1, 0, 3), columns(4, 1, 0, 1)]), 4, 1);
    let &[both, one, also, none] = &membership.groups[..] else { panic!("four pixels") };
    assert_eq!((one, none), (also, Membership::NONE));
    assert!((membership.similarity(both, one) - 0.5).abs() < 1e-5);
    assert_eq!(membership.similarity(both, one), membership.similarity(one, both));
    assert!((membership.similarity(both, both) - 1.0).abs() < 1e-5);
    // The denominator of the paper is there.
    assert!(membership.similarity(one, one) < 1.0);
}

/// Mean cosine within and across two masks after `steps` of Adam on a toy image, one feature per pixel.
fn toy(steps: usize, sign: f32) -> (f64, f64) {
    let membership = Membership::new(&set(16, 8, vec![columns(16, 8, 0, 8), columns(16, 8, 8, 16)]), 16, 8);
    let (n, c) = (128, 16);
    let mut random = noise(9);
    // Alike to start with, as features of one wall are.
    let mut features: Vec<f32> = (0..n * c).map(|_| 0.1 + 0.1 * random()).collect();
    let (mut grad, mut adam) = (vec![0.0; n * c], RowAdam::new(n, c, 1e-3));
    for _ in 0..steps {
        compactness(&features, c, &membership.groups, &membership, &mut grad);
        grad.iter_mut().for_each(|g| *g *= sign);
        adam.step(&mut features, &grad);
    }
    let feature = |p: usize| &features[p * c..(p + 1) * c];
    let (mut within, mut across, mut within_n, mut across_n) = (0.0, 0.0, 0.0, 0.0);
    for p in 0..n {
        for q in 0..p {
            if membership.groups[p] == membership.groups[q] {
                within += cosine(feature(p), feature(q));
                within_n += 1.0;
            } else {
                across += cosine(feature(p), feature(q));
                across_n += 1.0;
            }
        }
    }
    (within / within_n, across / across_n)
}

#[test]
fn two_masks_come_apart_and_the_papers_sign_does_the_opposite() {
    let (within, across) = toy(0, 1.0);
    assert!((within - across).abs() < 0.1, "{within} {across}");
    let (within, across) = toy(500, 1.0);
    assert!(within > 0.95 && across < 0.05, "within {within}, across {across}");
    let (within, across) = toy(500, -1.0);
    assert!(within < across, "within {within}, across {across}");
}

#[test]
fn poison_has_no_part() {
    let membership = tangle();
    let mut features = vec![0.5f32; 64 * 2];
    features[0..2].fill(0.0);
    features[2] = f32::NAN;
    features[4] = f32::INFINITY;
    features[6] = f32::MIN_POSITIVE;
    features[7] = 0.0;
    let mut grad = vec![1.0; 128];
    let result = compactness(&features, 2, &membership.groups, &membership, &mut grad);
    assert!(result.loss.is_finite() && grad.iter().all(|g| g.is_finite()), "{result:?}");
    assert_eq!(grad[..8], [0.0; 8]);

    // No pixel, one pixel, no mask, only empty masks.
    assert_eq!(compactness(&[], 2, &[], &membership, &mut []).loss, 0.0);
    assert_eq!(compactness(&[1.0, 2.0], 2, &[0], &membership, &mut [0.0; 2]).loss, 0.0);
    let none = Membership::new(&set(3, 2, vec![]), 3, 2);
    assert_eq!((none.groups.clone(), none.sets.len()), (vec![Membership::NONE; 6], 0));
    let empty = Membership::new(&set(3, 2, vec![Mask::empty(3, 2); 4]), 3, 2);
    assert_eq!((&empty.groups, &empty.sets), (&none.groups, &none.sets));
    let result = compactness(&features[20..32], 2, &empty.groups, &empty, &mut grad[..12]);
    assert_eq!((result.loss, &grad[..12]), (0.0, &[0.0; 12][..]));
}
