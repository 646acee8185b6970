//! Automatic masks by a network of SAM's interface: prompted on a grid, filtered, one of each kind kept.

use crate::toy;
use segwild_masks::{MaskSettings, generate};
use segwild_scene::{Image, Mask};
use segwild_vision::{ModelChoice, Providers, VisionSettings};

const W: usize = 160;
const H: usize = 112;

/// Three blocks of colours far from each other and from the ground, a speck of one of them, and a hole in another.
fn colour(x: u32, y: u32) -> [f32; 3] {
    match (x, y) {
        (20..60, 20..60) if !((35..40).contains(&x) && (35..40).contains(&y)) => [0.9, 0.1, 0.1],
        (100..140, 20..60) => [0.1, 0.9, 0.1],
        (20..140, 80..100) => [0.1, 0.1, 0.9],
        (80..85, 5..10) => [0.1, 0.9, 0.1],
        _ => [0.5, 0.5, 0.5],
    }
}

#[test]
fn each_thing_is_found_once_whole_and_without_specks() {
    if !toy::can_run("each_thing_is_found_once_whole_and_without_specks") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    toy::write_usual(folder.path());
    let all = Providers::from_settings(&VisionSettings {
        models: folder.path().display().to_string(),
        masks: ModelChoice::Sam,
        ..VisionSettings::default()
    })
    .unwrap();
    let mut image = Image::zeros(W, H, 3);
    for (i, v) in image.data.iter_mut().enumerate() {
        *v = colour((i % W) as u32, (i / W % H) as u32)[i / (W * H)];
    }
    let points: Vec<[f32; 2]> =
        (0..16 * 16).map(|i| [(i % 16) as f32 * 10.0 + 5.0, (i / 16) as f32 * 7.0 + 3.5]).collect();
    let settings =
        MaskSettings { min_masks: 0, min_mask_area: 0.005, prompt_batch: 100, ..MaskSettings::default() };
    let made = generate(&*all.proposer, &image, &points, None, &settings).unwrap();
    let t = made.tally;
    assert_eq!((t.prompts, t.proposed), (256, 768), "three masks per prompt");
    assert_eq!(t.doubtful + t.unstable + t.small + t.duplicates + t.kept, 768, "{t:?}");
    assert!(t.duplicates > 400 && t.unstable > 100, "{t:?}");
    // The speck is gone and the hole is closed: both are under half a percent of the photo.
    let things = [
        Mask::from_fn(W as u32, H as u32, |x, y| (20..60).contains(&x) && (20..60).contains(&y)),
        Mask::from_fn(W as u32, H as u32, |x, y| (100..140).contains(&x) && (20..60).contains(&y)),
        Mask::from_fn(W as u32, H as u32, |x, y| (20..140).contains(&x) && (80..100).contains(&y)),
    ];
    for (k, thing) in things.iter().enumerate() {
        let like: Vec<f64> = made.set.masks.iter().map(|m| m.mask.iou(thing)).filter(|&i| i > 0.5).collect();
        assert!(like.len() == 1 && like[0] > 0.85, "thing {k}: {like:?}");
    }
    assert!(made.set.masks.iter().all(|m| m.predicted_iou >= 0.88 && m.stability >= 0.95));
    for (i, a) in made.set.masks.iter().enumerate() {
        assert!(made.set.masks[..i].iter().all(|b| a.mask.iou(&b.mask) <= 0.7));
    }
    // With a further offset fewer masks are stable.
    let strict = Providers::from_settings(&VisionSettings {
        models: folder.path().display().to_string(),
        masks: ModelChoice::Sam,
        stability_offset: 9.0,
        ..VisionSettings::default()
    })
    .unwrap();
    let fewer = generate(&*strict.proposer, &image, &points, None, &settings).unwrap().tally;
    assert!(fewer.unstable > t.unstable, "{fewer:?} {t:?}");
}
