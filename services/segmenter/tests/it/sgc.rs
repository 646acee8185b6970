//! The spike cut (method, section 7): what it promises for any covariance.

use glam::{Mat3, Vec3};
use proptest::prelude::*;
use segwild_scene::{Camera, Mask, NEAR, Pose, Splats};
use segwild_segmenter::{CutView, MaskVote, SpikeCut, SpikeMode};

const CAMERA: Camera = Camera { width: 200, height: 160, fx: 180.0, fy: 180.0, cx: 100.0, cy: 80.0 };

fn pose() -> Pose {
    Pose { rotation: Mat3::IDENTITY, translation: Vec3::ZERO }
}

fn disc() -> Mask {
    Mask::from_fn(CAMERA.width, CAMERA.height, |x, y| (x as f32 - 100.0).hypot(y as f32 - 80.0) < 50.0)
}

fn view(mask: &Mask) -> CutView<'_> {
    CutView { camera: CAMERA, pose: pose(), mask, sees: None }
}

fn splats(rows: &[([f32; 3], [f32; 3], [f32; 4])]) -> Splats {
    Splats {
        means: rows.iter().map(|r| r.0).collect(),
        log_scales: rows.iter().map(|r| r.1).collect(),
        rotations: rows.iter().map(|r| r.2).collect(),
        opacities: vec![1.0; rows.len()],
        sh_degree: 0,
        sh: vec![0.5; 3 * rows.len()],
    }
}

fn all(n: usize) -> Vec<bool> {
    vec![true; n]
}

/// A needle along x at depth 1, `pixels` long at 3 standard deviations, its centre at pixel x `at`.
fn needle(at: f32, pixels: f32) -> Splats {
    let sigma = (pixels / 3.0 / 180.0).ln();
    splats(&[([(at - 100.0) / 180.0, 0.0, 1.0], [sigma, -7.0, -7.0], [1.0, 0.0, 0.0, 0.0])])
}

#[test]
fn a_needle_is_cut_at_the_boundary() {
    // 40 px long, centred on the disc's right edge at x = 150: half of it stays, in 130..150.
    let before = needle(150.0, 40.0);
    let cut = SpikeCut::new(&before, &all(1), &[view(&disc())], SpikeMode::Axis, NEAR);
    let mut after = before.clone();
    cut.apply(&mut after);
    let (centre, length) = (after.means[0][0] * 180.0 + 100.0, after.scale(0).x * 3.0 * 180.0);
    assert!((centre - 140.0).abs() < 1.0 && (length - 20.0).abs() < 1.5, "centre {centre}, length {length}");
    // Thickness, depth and opacity stay.
    assert!((after.log_scales[0][1] + 7.0).abs() < 1e-3, "{:?}", after.log_scales);
    assert!((after.means[0][2] - 1.0).abs() < 1e-4, "{:?}", after.means);
    assert_eq!(after.opacities, before.opacities);
    cut.undo(&mut after);
    assert_eq!(after, before);
}

#[test]
fn isotropic_mode_shrinks_every_axis() {
    let mut after = needle(150.0, 40.0);
    SpikeCut::new(&after.clone(), &all(1), &[view(&disc())], SpikeMode::Isotropic, NEAR).apply(&mut after);
    assert!((after.log_scales[0][1] - (-7.0 + 0.5f32.ln())).abs() < 0.1);
}

#[test]
fn what_is_inside_stays_and_what_is_outside_goes() {
    let mask = disc();
    let inside = SpikeCut::new(&needle(100.0, 40.0), &all(1), &[view(&mask)], SpikeMode::Axis, NEAR);
    assert_eq!(inside, SpikeCut::default());
    let outside = SpikeCut::new(&needle(185.0, 20.0), &all(1), &[view(&mask)], SpikeMode::Axis, NEAR);
    assert_eq!((outside.changed.len(), &outside.dropped[..]), (0, &[0][..]));
    let mut labels = vec![true];
    outside.trim(&mut labels);
    assert_eq!(labels, [false]);
    // Not selected, not seen, or switched off: not touched.
    let spike = needle(185.0, 20.0);
    assert_eq!(SpikeCut::new(&spike, &[false], &[view(&mask)], SpikeMode::Axis, NEAR), SpikeCut::default());
    let blind = CutView { sees: Some(&[false]), ..view(&mask) };
    assert_eq!(SpikeCut::new(&spike, &all(1), &[blind], SpikeMode::Axis, NEAR), SpikeCut::default());
    assert_eq!(SpikeCut::new(&spike, &all(1), &[view(&mask)], SpikeMode::Off, NEAR), SpikeCut::default());
}

#[test]
fn both_ends_outside_keeps_the_middle() {
    let mut after = needle(110.0, 160.0);
    let cut = SpikeCut::new(&after.clone(), &all(1), &[view(&disc())], SpikeMode::Axis, NEAR);
    cut.apply(&mut after);
    let (centre, length) = (after.means[0][0] * 180.0 + 100.0, after.scale(0).x * 3.0 * 180.0);
    assert!((centre - 100.0).abs() < 1.5 && (length - 100.0).abs() < 2.5, "centre {centre}, length {length}");
}

#[test]
fn the_frame_ends_the_mask() {
    let full = Mask::full(CAMERA.width, CAMERA.height);
    let mut after = needle(195.0, 40.0);
    SpikeCut::new(&after.clone(), &all(1), &[view(&full)], SpikeMode::Axis, NEAR).apply(&mut after);
    let end = after.means[0][0] * 180.0 + 100.0 + after.scale(0).x * 1.5 * 180.0;
    assert!((end - 200.0).abs() < 1.5, "{end}");
}

#[test]
fn a_mask_of_another_size_cuts_at_the_same_position() {
    let small = disc().resized(100, 80);
    let mut after = needle(150.0, 40.0);
    SpikeCut::new(&after.clone(), &all(1), &[view(&small)], SpikeMode::Axis, NEAR).apply(&mut after);
    let length = after.scale(0).x * 3.0 * 180.0;
    assert!((length - 20.0).abs() < 3.0, "{length}");
}

/// Ellipsoids of all kinds around and across the disc.
fn zoo(n: usize, seed: u64) -> Splats {
    let mut state = seed;
    let mut next = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 24) as f32
    };
    let rows: Vec<_> = (0..n)
        .map(|_| {
            let z = 0.5 + 2.0 * next();
            let p = [(next() - 0.5) * z, (next() - 0.5) * 0.8 * z, z];
            let s = [0, 0, 0].map(|_: i32| (-7.5 + 5.0 * next()) + z.ln());
            (p, s, [0, 0, 0, 0].map(|_: i32| next() - 0.5))
        })
        .collect();
    splats(&rows)
}

#[test]
fn a_second_cut_finds_nothing_to_do() {
    for mode in [SpikeMode::Axis, SpikeMode::Isotropic] {
        let (mask, mut scene) = (disc(), zoo(4000, 11));
        let mut labels = all(scene.len());
        let first = SpikeCut::new(&scene, &labels, &[view(&mask)], mode, NEAR);
        first.apply(&mut scene);
        first.trim(&mut labels);
        assert!(first.changed.len() > 400, "{} cut", first.changed.len());
        let second = SpikeCut::new(&scene, &labels, &[view(&mask)], mode, NEAR);
        let kept = labels.iter().filter(|l| **l).count();
        let again = second.changed.len() + second.dropped.len();
        eprintln!(
            "{mode}: first {} cut, {} dropped; second {again} of {kept}",
            first.changed.len(),
            first.dropped.len()
        );
        assert!(
            again * 20 <= first.changed.len(),
            "{mode}: {again} of {} changed again",
            first.changed.len()
        );
    }
}

#[test]
fn the_image_of_a_tilted_splat_shrinks_along_the_cut_only() {
    // Sigma_uv before and after, by the definition: along the major axis r² of it is left, across it nothing changes.
    let scene = zoo(4000, 5);
    let mask = disc();
    let cut = SpikeCut::new(&scene, &all(scene.len()), &[view(&mask)], SpikeMode::Axis, NEAR);
    let mut after = scene.clone();
    cut.apply(&mut after);
    let image = |s: &Splats, i: usize| {
        let (p, c) = (s.mean(i).as_dvec3(), s.covariance(i).as_dmat3());
        let u = glam::DVec3::new(180.0 / p.z, 0.0, -180.0 * p.x / p.z / p.z);
        let v = glam::DVec3::new(0.0, 180.0 / p.z, -180.0 * p.y / p.z / p.z);
        let (a, b, d) = (u.dot(c * u), u.dot(c * v), v.dot(c * v));
        (0.5 * (a + d) + (0.5 * (a - d)).hypot(b), a * d - b * b)
    };
    let mut shorter = 0;
    for &(i, ..) in &cut.changed {
        let i = i as usize;
        let ((major, det), (_, det_after)) = (image(&scene, i), image(&after, i));
        let minor = det / major;
        // At the same depth the area shrinks with the length: never more than the whole cut explains.
        let depth = (f64::from(scene.means[i][2]) / f64::from(after.means[i][2])).powi(4);
        assert!(det_after <= det * depth * 1.05 + 1e-9, "splat {i}: {det} to {det_after}");
        shorter += usize::from(image(&after, i).0.max(minor) < 0.95 * major);
    }
    assert!(shorter * 10 > cut.changed.len() * 6, "{shorter} of {}", cut.changed.len());
}

#[test]
fn views_cut_one_after_the_other() {
    let left = Mask::from_fn(200, 160, |x, _| x < 120);
    let right = Mask::from_fn(200, 160, |x, _| x >= 80);
    let mut after = needle(100.0, 120.0);
    SpikeCut::new(&after.clone(), &all(1), &[view(&left), view(&right)], SpikeMode::Axis, NEAR)
        .apply(&mut after);
    let (centre, half) = (after.means[0][0] * 180.0 + 100.0, after.scale(0).x * 1.5 * 180.0);
    assert!((centre - half - 80.0).abs() < 2.0 && (centre + half - 120.0).abs() < 2.0, "{centre} +- {half}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    #[test]
    fn any_covariance_gives_finite_splats(
        mean in proptest::array::uniform3(prop_oneof![8 => -2.0f32..2.0, 1 => Just(f32::NAN), 1 => Just(1e20f32), 1 => Just(0.01f32)]),
        log_scales in proptest::array::uniform3(prop_oneof![6 => -12.0f32..3.0, 1 => Just(-1e4f32), 1 => Just(90.0f32), 1 => Just(30.0f32), 1 => Just(f32::NAN), 1 => Just(f32::NEG_INFINITY)]),
        rotation in proptest::array::uniform4(prop_oneof![6 => -1.0f32..1.0, 1 => Just(0.0f32), 1 => Just(1e-30f32), 1 => Just(f32::NAN), 1 => Just(1e30f32)]),
        isotropic in any::<bool>(),
    ) {
        let scene = splats(&[(mean, log_scales, rotation)]);
        let mode = if isotropic { SpikeMode::Isotropic } else { SpikeMode::Axis };
        let turned = Pose::look_at(Vec3::new(0.3, 0.2, -1.0), Vec3::new(0.0, 0.0, 1.0), Vec3::Y);
        let mask = disc();
        let views = [view(&mask), CutView { pose: turned, ..view(&mask) }];
        let cut = SpikeCut::new(&scene, &[true], &views, mode, NEAR);
        let mut after = scene.clone();
        cut.apply(&mut after);
        for (_, _, g) in &cut.changed {
            prop_assert!(g.mean.iter().chain(&g.log_scales).chain(&g.rotation).all(|x| x.is_finite()), "{:?}", g);
            prop_assert!((g.rotation.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-5);
        }
        cut.undo(&mut after);
        prop_assert_eq!(format!("{after:?}"), format!("{scene:?}"));
    }
}

/// Photos side by side, each with an outline of its own.
fn votes_of(masks: &[Mask]) -> Vec<MaskVote<'_>> {
    let mask_vote = |mask| MaskVote { camera: CAMERA, pose: pose(), mask, visibility: &[255], weight: 1.0 };
    masks.iter().map(mask_vote).collect()
}

fn left_of(edge: u32) -> Mask {
    Mask::from_fn(CAMERA.width, CAMERA.height, move |x, _| x < edge)
}

/// Nothing is astride.
const NONE: [bool; 1] = [false];

#[test]
fn most_photos_cut_a_needle_where_most_of_them_end_the_object() {
    // 60 px long (3 deviations of 20), its centre at x = 150. Five outlines wander about x = 150, one is far off.
    let before = needle(150.0, 60.0);
    let masks = [147, 149, 150, 151, 153, 198].map(left_of);
    let cut = SpikeCut::cut_by_votes(&before, &all(1), &NONE, &votes_of(&masks), SpikeMode::Axis, NEAR);
    let mut after = before.clone();
    cut.apply(&mut after);
    // What is seen of it ends where half of its alpha is lost, at 1.177 deviations.
    let end = after.means[0][0] * 180.0 + 100.0 + after.scale(0).x * 180.0 * 1.177;
    assert!((end - 151.5).abs() < 3.0, "seen up to x = {end}");
    assert!(after.scale(0).x < 0.7 * before.scale(0).x);
    assert_eq!((after.log_scales[0][1], after.opacities[0]), (before.log_scales[0][1], before.opacities[0]));
    // Applying it again changes nothing.
    let again = SpikeCut::cut_by_votes(&after, &all(1), &NONE, &votes_of(&masks), SpikeMode::Axis, NEAR);
    assert_eq!(again, SpikeCut::default());
    cut.undo(&mut after);
    assert_eq!(after, before);
}

#[test]
fn one_photo_that_is_wrong_cuts_nothing() {
    let needle = needle(150.0, 60.0);
    let masks = [110, 190, 195, 198].map(left_of);
    assert_eq!(
        SpikeCut::cut_by_votes(&needle, &all(1), &NONE, &votes_of(&masks), SpikeMode::Axis, NEAR),
        SpikeCut::default()
    );
    // Nor do photos that do not see it, however many.
    let blind = [110; 8].map(left_of);
    let votes: Vec<MaskVote> =
        votes_of(&blind).into_iter().map(|j| MaskVote { visibility: &[0], ..j }).collect();
    assert_eq!(
        SpikeCut::cut_by_votes(&needle, &all(1), &NONE, &votes, SpikeMode::Axis, NEAR),
        SpikeCut::default()
    );
}

#[test]
fn what_all_photos_put_outside_leaves_the_selection() {
    let masks = [60; 4].map(left_of);
    let cut = SpikeCut::cut_by_votes(
        &needle(150.0, 60.0),
        &all(1),
        &NONE,
        &votes_of(&masks),
        SpikeMode::Axis,
        NEAR,
    );
    assert_eq!((cut.changed.len(), cut.dropped), (0, vec![0]));
}

#[test]
fn a_splat_astride_the_outline_gives_the_object_its_inner_piece() {
    // Two thirds of the needle lie outside; it belongs to something else.
    let before = needle(150.0, 60.0);
    let masks = [140; 4].map(left_of);
    let cut = SpikeCut::cut_by_votes(&before, &NONE, &all(1), &votes_of(&masks), SpikeMode::Axis, NEAR);
    assert_eq!((cut.joined.as_slice(), cut.changed.len(), cut.dropped.len()), ([0u32].as_slice(), 1, 0));
    let (mut after, mut labels) = (before.clone(), vec![false]);
    cut.apply(&mut after);
    cut.trim(&mut labels);
    assert_eq!(labels, [true]);
    let end = after.means[0][0] * 180.0 + 100.0 + after.scale(0).x * 180.0 * 1.177;
    assert!((end - 140.0).abs() < 3.0, "seen up to x = {end}");
    // Once in, a second cut finds nothing to change.
    assert_eq!(
        SpikeCut::cut_by_votes(&after, &labels, &NONE, &votes_of(&masks), SpikeMode::Axis, NEAR),
        SpikeCut::default()
    );
    // What no photo's outline cuts stays whole, and stays out.
    let around = [190; 4].map(left_of);
    assert_eq!(
        SpikeCut::cut_by_votes(&before, &NONE, &all(1), &votes_of(&around), SpikeMode::Axis, NEAR),
        SpikeCut::default()
    );
    // And nothing joins where spikes are not cut.
    assert_eq!(
        SpikeCut::cut_by_votes(&before, &NONE, &all(1), &votes_of(&masks), SpikeMode::Off, NEAR),
        SpikeCut::default()
    );
}
