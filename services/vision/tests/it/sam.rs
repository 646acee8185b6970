//! Networks of the SAM family, by small ones of the same interfaces: what is sent to them and what is made of their
//! answers.

use crate::toy::{
    self, EFFICIENT, PIXEL_KINDS, SAM, SCORES, Takes, ToyDecoder, ToyFault, can_run, decoder, encoder,
};
use segwild_scene::{BoxPrompt, Image, Mask, PointPrompt, Prompts, ScoredMask};
use segwild_vision::{ModelChoice, Providers, VisionSettings, Work};
use std::path::Path;

const W: usize = 160;
const H: usize = 112;

/// A grey ground with a red square, a square of nearly that red, and a blue bar.
fn photo() -> Image {
    let mut image = Image::zeros(W, H, 3);
    for (x, y) in (0..H).flat_map(|y| (0..W).map(move |x| (x, y))) {
        let (x, y) = (x as u32, y as u32);
        let colour = if red(x, y) {
            [0.8, 0.2, 0.2]
        } else if reddish(x, y) {
            [0.65, 0.2, 0.2]
        } else if blue(x, y) {
            [0.1, 0.2, 0.9]
        } else {
            [0.5, 0.5, 0.5]
        };
        (0..3).for_each(|c| image.data[(c * H + y as usize) * W + x as usize] = colour[c]);
    }
    image
}

// Edges lie on the cells' (of 2.5 pixels each).
fn red(x: u32, y: u32) -> bool {
    (20..60).contains(&x) && (20..60).contains(&y)
}
fn reddish(x: u32, y: u32) -> bool {
    (100..140).contains(&x) && (20..60).contains(&y)
}
fn blue(x: u32, y: u32) -> bool {
    (20..140).contains(&x) && (80..100).contains(&y)
}

fn truth(inside: impl Fn(u32, u32) -> bool) -> Mask {
    Mask::from_fn(W as u32, H as u32, inside)
}

fn providers(folder: &Path, change: impl Fn(&mut VisionSettings)) -> Providers {
    let mut settings = VisionSettings {
        models: folder.display().to_string(),
        masks: ModelChoice::Sam,
        embedder: ModelChoice::Sam,
        ..VisionSettings::default()
    };
    change(&mut settings);
    Providers::from_settings(&settings).unwrap()
}

/// The providers of a pair.
fn pair(folder: &Path, takes: Takes, d: ToyDecoder) -> Providers {
    toy::write(folder, "sam", &encoder(takes, ToyFault::None), &decoder(d));
    providers(folder, |_| ())
}

fn is(mask: &ScoredMask, expected: &Mask, what: &str) {
    let iou = mask.mask.iou(expected);
    // Between a cell's logit and its neighbour's the mask's edge may lie a pixel further in.
    assert!(iou > 0.88, "{what}: IoU {iou:.3}");
}

fn click(x: f32, y: f32, inside: bool) -> PointPrompt {
    PointPrompt { x, y, inside }
}

#[test]
fn a_click_gives_three_nested_masks_whatever_the_interface() {
    let test = "a_click_gives_three_nested_masks_whatever_the_interface";
    if !can_run(test) {
        return;
    }
    let three = ToyDecoder { masks: 3, ..SAM };
    let interfaces = [
        ("SAM", Takes::Planes, SAM),
        ("SAM without the mask for precise prompts", Takes::Planes, three),
        ("SAM of many queries", Takes::Planes, ToyDecoder { queries: toy::onnx::OPEN, ..SAM }),
        ("SAM of a fixed number of points", Takes::Planes, ToyDecoder { points: 5, ..SAM }),
        ("SAM of full-size masks alone", Takes::Planes, ToyDecoder { small: false, ..SAM }),
        ("SAM of packed floats", Takes::Pixels(PIXEL_KINDS[0]), SAM),
        ("SAM of packed bytes", Takes::Pixels(PIXEL_KINDS[1]), SAM),
        ("EfficientSAM", Takes::Whole, EFFICIENT),
        ("EfficientSAM of full-size masks alone", Takes::Whole, ToyDecoder { small: false, ..EFFICIENT }),
        ("EfficientSAM of four queries", Takes::Whole, ToyDecoder { queries: 4, points: 6, ..EFFICIENT }),
    ];
    let (image, expected) = (photo(), [truth(red), truth(|x, y| red(x, y) || reddish(x, y))]);
    for (what, takes, d) in interfaces {
        let folder = tempfile::tempdir().unwrap();
        let all = pair(folder.path(), takes, d);
        // Twenty clicks: more than are sent at once, and no multiple of it.
        let points: Vec<[f32; 2]> = (0..21).map(|i| [30.0 + i as f32, 40.0]).collect();
        let masks = all.proposer.propose(&image, &points).unwrap();
        assert_eq!(masks.len(), 3 * points.len(), "{what}");
        for nested in masks.chunks(3) {
            is(&nested[0], &expected[0], what);
            is(&nested[1], &expected[1], what);
            assert!(nested.iter().zip(SCORES).all(|(m, score)| m.predicted_iou == score), "{what}");
            assert!(nested.iter().all(|m| m.stability > 0.9 && m.stability <= 1.0), "{what}");
        }
        // The mask that it scores highest is the answer to a click.
        let found = all.segmenter.prompted(&image, &Prompts::click(40.0, 40.0)).unwrap();
        let answer = found.answer;
        is(&answer, &expected[1], what);
        // The chance that its logits give a pixel, for those that it leaves out.
        let fits =
            |(i, p): (usize, &f32)| if answer.mask.index(i) { *p == 0.0 } else { (0.0..=0.5).contains(p) };
        assert!(found.open.data.iter().enumerate().all(fits), "{what}");
        assert!(found.open.data.iter().any(|p| *p > 0.0), "{what}");
        assert_eq!(answer.predicted_iou, 0.95, "{what}");
        for (granularity, expected) in [(0.0, &expected[0]), (0.5, &expected[1])] {
            let prompts = Prompts { granularity: Some(granularity), ..Prompts::click(40.0, 40.0) };
            is(&all.segmenter.segment(&image, &prompts).unwrap(), expected, what);
        }
    }
}

#[test]
fn one_mask_per_prompt_is_enough() {
    if !can_run("one_mask_per_prompt_is_enough") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let all = pair(folder.path(), Takes::Planes, ToyDecoder { masks: 1, ..SAM });
    let prompts = Prompts { granularity: Some(0.0), ..Prompts::click(40.0, 40.0) };
    let mask = all.segmenter.segment(&photo(), &prompts).unwrap();
    assert_eq!(mask.predicted_iou, 0.91);
    assert_eq!(all.proposer.propose(&photo(), &[[40.0, 40.0]]).unwrap().len(), 1);
}

#[test]
fn masks_are_scaled_to_the_photo_as_the_published_export_scales_them() {
    if !can_run("masks_are_scaled_to_the_photo_as_the_published_export_scales_them") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let full = ToyDecoder { small: false, ..SAM };
    // Landscape, portrait, square, and one larger than the encoder's square.
    for (w, h) in [(160, 112), (75, 160), (90, 90), (1300, 40)] {
        let image = photo().resized(w, h);
        let ours = pair(&folder.path().join("small"), Takes::Planes, SAM);
        let theirs = pair(&folder.path().join("full"), Takes::Planes, full);
        let points = [[0.25 * w as f32, 0.35 * h as f32], [0.5 * w as f32, 0.8 * h as f32]];
        let (ours, theirs) = (
            ours.proposer.propose(&image, &points).unwrap(),
            theirs.proposer.propose(&image, &points).unwrap(),
        );
        assert_eq!(ours.len(), theirs.len());
        for (a, b) in ours.iter().zip(&theirs) {
            let different = a.mask.or(&b.mask).count() - a.mask.and(&b.mask).count();
            // A logit of nearly zero may fall on either side.
            assert!(different * 2000 <= w * h, "{w} x {h}: {different} pixels differ");
            assert!((a.stability - b.stability).abs() < 2e-3, "{} {}", a.stability, b.stability);
        }
    }
}

#[test]
fn clicks_outside_and_boxes_change_the_mask() {
    if !can_run("clicks_outside_and_boxes_change_the_mask") {
        return;
    }
    for (takes, d) in [(Takes::Planes, SAM), (Takes::Whole, EFFICIENT)] {
        let folder = tempfile::tempdir().unwrap();
        let all = pair(folder.path(), takes, d);
        let image = photo();
        let ask = |points: Vec<PointPrompt>, boxes: Vec<BoxPrompt>| {
            all.segmenter.segment(&image, &Prompts { points, boxes, granularity: None }).unwrap()
        };
        let both = ask(vec![click(40.0, 40.0, true)], vec![]);
        is(&both, &truth(|x, y| red(x, y) || reddish(x, y)), "both reds");
        let one = ask(vec![click(40.0, 40.0, true), click(120.0, 40.0, false)], vec![]);
        is(&one, &truth(red), "less what is like the click outside");
        // The order of the clicks is no matter where the first one inside begins.
        let turned = ask(vec![click(120.0, 40.0, false), click(40.0, 40.0, true)], vec![]);
        assert_eq!(turned.mask, one.mask);
        let left = BoxPrompt { x0: 80.0, y0: 10.0, x1: 10.0, y1: 70.0 };
        is(&ask(vec![click(40.0, 40.0, true)], vec![left]), &truth(red), "within the box");
        let near = |x, y| (20..140).contains(&x) && (80..100).contains(&y);
        let bar = BoxPrompt { x0: 20.0, y0: 80.0, x1: 140.0, y1: 100.0 };
        is(&ask(vec![], vec![bar]), &truth(near), "the box alone");
        let together = ask(vec![click(40.0, 40.0, true)], vec![left, bar]);
        is(&together, &truth(|x, y| red(x, y) || near(x, y)), "two boxes");
        let apart = ask(vec![click(40.0, 90.0, true), click(40.0, 40.0, true)], vec![left]);
        is(&apart, &truth(|x, y| red(x, y) || blue(x, y)), "a click beside the box");
    }
}

#[test]
fn a_further_click_costs_one_prompt_and_goes_on_from_the_answer_before() {
    if !can_run("a_further_click_costs_one_prompt_and_goes_on_from_the_answer_before") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let all = pair(folder.path(), Takes::Planes, SAM);
    let image = photo();
    let done = || all.proposer.work().unwrap();
    let ask = |points: &[PointPrompt]| {
        let prompts = Prompts { points: points.to_vec(), ..Prompts::default() };
        all.segmenter.segment(&image, &prompts).unwrap()
    };
    let clicks = [click(40.0, 40.0, true), click(60.0, 90.0, true), click(120.0, 40.0, false)];
    for n in 1..=3 {
        ask(&clicks[..n]);
        let Work { encoded, prompts, .. } = done();
        assert_eq!((encoded, prompts), (1, n as u64));
    }
    let last = ask(&clicks);
    assert_eq!(done().prompts, 3, "answered before");
    is(&last, &truth(|x, y| red(x, y) || blue(x, y)), "two clicks in, one out");
    assert_eq!(last.predicted_iou, 0.99, "precise prompts take the decoder's first mask");
    // With the same clicks at once, the answers before are given to the decoder as well.
    let fresh = providers(folder.path(), |_| ());
    let prompts = Prompts { points: clicks.to_vec(), ..Prompts::default() };
    assert_eq!(fresh.segmenter.segment(&image, &prompts).unwrap(), last);
    assert_eq!(fresh.proposer.work().unwrap().prompts, 3);
    let work = done();
    assert!(work.seconds_per_image().unwrap() > 0.0 && work.prompts_per_second().unwrap() > 0.0);
}

#[test]
fn a_photo_that_was_prepared_is_not_encoded_again() {
    if !can_run("a_photo_that_was_prepared_is_not_encoded_again") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let all = pair(folder.path(), Takes::Planes, SAM);
    let image = photo();
    assert!(!all.segmenter.is_prepared(&image));
    all.segmenter.prepare(&image);
    assert!(all.segmenter.is_prepared(&image));
    assert_eq!(all.proposer.work().unwrap().encoded, 1);
    let prompts = Prompts { points: vec![click(40.0, 40.0, true)], ..Prompts::default() };
    let answer = all.segmenter.segment(&image, &prompts).unwrap();
    let Work { encoded, prompts: count, .. } = all.proposer.work().unwrap();
    assert_eq!((encoded, count), (1, 1));
    assert_eq!(answer, providers(folder.path(), |_| ()).segmenter.segment(&image, &prompts).unwrap());
}

#[test]
fn the_embedding_covers_the_photo_and_no_padding() {
    if !can_run("the_embedding_covers_the_photo_and_no_padding") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for (takes, d, size) in [
        (Takes::Planes, SAM, [64, 45]),
        (Takes::Pixels(2), SAM, [61, 43]),
        (Takes::Whole, EFFICIENT, [64, 64]),
    ] {
        let all = pair(folder.path(), takes, d);
        let e = all.embedder.embed(&photo()).unwrap();
        // 112 of 160 pixels: 44.8 of 64 cells; the encoder for landscapes has room for 684 of 1024 pixels.
        assert_eq!(([e.width, e.height], e.channels), (size, 256));
        assert_eq!(e.data.len(), 256 * e.width * e.height);
        let at = |channel: usize, x: f32, y: f32| {
            let (x, y) = ((x * e.width as f32) as usize, (y * e.height as f32) as usize);
            e.data[(channel * e.height + y) * e.width + x]
        };
        // The middle of the red square and of the blue bar, standardised by the published figures.
        for (position, colour) in [([0.25, 0.36], [0.8, 0.2, 0.2]), ([0.5, 0.8], [0.1, 0.2, 0.9])] {
            let (mean, deviation) = ([123.675, 116.28, 103.53], [58.395, 57.12, 57.375]);
            for c in 0..3 {
                let expected = (255.0 * colour[c] - mean[c]) / deviation[c];
                let got = at(c, position[0], position[1]);
                assert!((got - expected).abs() < 0.03, "{c}: {got} is not {expected}");
            }
        }
        // Bottom right is the photo's corner, and no padding.
        assert!((at(0, 0.99, 0.99) - (127.5 - 123.675) / 58.395).abs() < 0.03);
    }
}

#[test]
fn a_rough_mask_snaps_to_the_photo() {
    if !can_run("a_rough_mask_snaps_to_the_photo") {
        return;
    }
    for (takes, d) in [(Takes::Planes, SAM), (Takes::Whole, EFFICIENT)] {
        let folder = tempfile::tempdir().unwrap();
        let all = pair(folder.path(), takes, d);
        let image = photo();
        // A soft disc around the red square, as a render of it might be.
        let mut certainty = Image::zeros(W, H, 1);
        for (i, v) in certainty.data.iter_mut().enumerate() {
            let (x, y) = ((i % W) as f32 - 40.0, (i / W) as f32 - 40.0);
            *v = (1.5 - (x * x + y * y).sqrt() / 28.0).clamp(0.0, 1.0);
        }
        let mask = all.segmenter.refine(&image, &certainty).unwrap();
        is(&mask, &truth(red), "the square under the disc");
        let nothing = all.segmenter.refine(&image, &Image::zeros(W, H, 1)).unwrap();
        assert!(nothing.mask.is_empty() && nothing.predicted_iou == 0.0);
        certainty.data[0] = f32::NAN;
        assert_eq!(all.segmenter.refine(&image, &certainty).unwrap().mask, mask.mask);
        let error = all.segmenter.refine(&image, &Image::zeros(3, 3, 1)).unwrap_err().to_string();
        assert!(error.contains("3 x 3"), "{error}");
    }
}

#[test]
fn each_part_can_be_selected_by_itself() {
    if !can_run("each_part_can_be_chosen_by_itself") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    toy::write_usual(folder.path());
    let keys = |change: &dyn Fn(&mut VisionSettings)| {
        let all = providers(folder.path(), change);
        [all.embedder.key(), all.proposer.key(), all.segmenter.key()].map(|k| k.starts_with("sam-"))
    };
    assert_eq!(keys(&|_| ()), [true; 3]);
    assert_eq!(keys(&|s| s.masks = ModelChoice::Builtin), [true, false, false]);
    assert_eq!(keys(&|s| s.embedder = ModelChoice::Builtin), [false, true, true]);
    let auto = |s: &mut VisionSettings| (s.masks, s.embedder) = (ModelChoice::Auto, ModelChoice::Auto);
    assert_eq!(keys(&auto), [true; 3]);
    let notes = providers(folder.path(), auto).notes;
    let note = notes.iter().find(|n| n.starts_with("SAM: MobileSAM")).unwrap();
    assert!(note.contains("on the CPU") && note.contains("Apache-2.0"), "{note}");
    assert!(!providers(folder.path(), |_| ()).proposer.accelerator(), "no lease is taken for a CPU's work");
}

#[test]
fn another_file_is_another_key() {
    if !can_run("another_file_is_another_key") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    toy::write_usual(folder.path());
    let keys = |offset: f32| {
        let all = providers(folder.path(), |s| s.stability_offset = offset);
        (all.embedder.key(), all.proposer.key())
    };
    let before = keys(1.0);
    assert_eq!(keys(1.0), before);
    assert_ne!(keys(0.5).1, before.1, "the offset makes other masks");
    assert_eq!(keys(0.5).0, before.0, "and the same embeddings");
    let other = decoder(ToyDecoder { masks: 3, ..SAM });
    toy::write(folder.path(), "mobile_sam", &encoder(Takes::Planes, ToyFault::None), &other);
    let after = keys(1.0);
    assert_eq!(after.0, before.0, "the encoder is the same");
    assert_ne!(after.1, before.1);
}
