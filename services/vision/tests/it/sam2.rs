//! SAM 2, SAM 3's tracker and SAM by Transformers, by small networks of the same interfaces: the photo is stretched over the
//! square, and every map, label and number arrives as the file declares it.

use crate::toy::sam2::{
    ORT_TOOL, SAM_CPP, SAM_TRANSFORMERS, SAMEXPORTER, TRACKER, TRANSFORMERS, ToyExport, decoder, encoder,
    halved,
};
use crate::toy::{self, SCORES, can_run};
use segwild_scene::{BoxPrompt, Image, Mask, PointPrompt, Prompts, ScoredMask};
use segwild_vision::{ModelChoice, Providers, SamFileError, VisionError, VisionSettings};
use std::path::Path;

const EXPORTS: [(&str, ToyExport); 5] = [
    ("samexporter", SAMEXPORTER),
    ("sam-cpp-macos", SAM_CPP),
    ("onnxruntime's tool", ORT_TOOL),
    ("Transformers", TRANSFORMERS),
    ("SAM 3's tracker", TRACKER),
];

/// Landscape and portrait. An eighth of each side is a whole number of pixels, and of cells of the square.
const SIZES: [[usize; 2]; 2] = [[160, 96], [96, 160]];

/// Rectangles in eighths of the photo's sides: x from, x to, y from, y to.
const RED: [u32; 4] = [1, 3, 1, 3];
const REDDISH: [u32; 4] = [5, 7, 1, 3];
const BLUE: [u32; 4] = [1, 7, 5, 6];

fn holds(eighths: [u32; 4], [w, h]: [usize; 2], x: u32, y: u32) -> bool {
    let (x, y) = (8 * x, 8 * y);
    let (w, h) = (w as u32, h as u32);
    (eighths[0] * w..eighths[1] * w).contains(&x) && (eighths[2] * h..eighths[3] * h).contains(&y)
}

/// A grey ground with a red rectangle, one of nearly that red, and a blue bar.
fn photo([w, h]: [usize; 2]) -> Image {
    let mut image = Image::zeros(w, h, 3);
    for i in 0..w * h {
        let is = |eighths| holds(eighths, [w, h], (i % w) as u32, (i / w) as u32);
        let colour = if is(RED) {
            [0.8, 0.2, 0.2]
        } else if is(REDDISH) {
            [0.65, 0.2, 0.2]
        } else if is(BLUE) {
            [0.1, 0.2, 0.9]
        } else {
            [0.5, 0.5, 0.5]
        };
        (0..3).for_each(|c| image.data[c * w * h + i] = colour[c]);
    }
    image
}

fn truth(size: [usize; 2], of: &[[u32; 4]]) -> Mask {
    Mask::from_fn(size[0] as u32, size[1] as u32, |x, y| of.iter().any(|e| holds(*e, size, x, y)))
}

/// A position in eighths of the sides, as a click.
fn click([w, h]: [usize; 2], [x, y]: [f32; 2], inside: bool) -> PointPrompt {
    PointPrompt { x: x * w as f32 / 8.0, y: y * h as f32 / 8.0, inside }
}

fn corners([w, h]: [usize; 2], [x0, x1, y0, y1]: [f32; 4]) -> BoxPrompt {
    let (w, h) = (w as f32 / 8.0, h as f32 / 8.0);
    BoxPrompt { x0: x0 * w, y0: y0 * h, x1: x1 * w, y1: y1 * h }
}

fn providers(folder: &Path) -> Providers {
    let settings = VisionSettings {
        models: folder.display().to_string(),
        masks: ModelChoice::Sam,
        embedder: ModelChoice::Sam,
        ..VisionSettings::default()
    };
    Providers::from_settings(&settings).unwrap()
}

/// The providers of an export's pair.
fn pair(folder: &Path, e: &ToyExport) -> Providers {
    toy::write(folder, "sam2.1_hiera_tiny", &encoder(e), &decoder(e));
    providers(folder)
}

fn is(mask: &ScoredMask, expected: &Mask, what: &str) {
    let iou = mask.mask.iou(expected);
    // From a cell's logit to its neighbour's the mask's edge may lie a pixel further in.
    assert!(iou > 0.85, "{what}: IoU {iou:.3}");
}

#[test]
fn a_click_is_answered_at_its_position_in_the_stretched_square() {
    if !can_run("a_click_is_answered_at_its_position_in_the_stretched_square") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for (what, e) in EXPORTS {
        for (k, size) in SIZES.into_iter().enumerate() {
            let all = pair(&folder.path().join(format!("{what}{k}")), &e);
            let image = photo(size);
            let expected = [truth(size, &[RED]), truth(size, &[RED, REDDISH])];
            // More clicks than are sent at once, and no multiple of it.
            let points: Vec<[f32; 2]> = (0..21)
                .map(|i| click(size, [1.5 + i as f32 / 20.0, 2.0], true))
                .map(|p| [p.x, p.y])
                .collect();
            let masks = all.proposer.propose(&image, &points).unwrap();
            assert_eq!(masks.len(), 3 * points.len(), "{what}");
            for nested in masks.chunks(3) {
                is(&nested[0], &expected[0], what);
                is(&nested[1], &expected[1], what);
                assert!(nested.iter().zip(SCORES).all(|(m, score)| m.predicted_iou == score), "{what}");
            }
            let points = vec![click(size, [2.0, 2.0], true)];
            for (granularity, expected) in
                [(None, 1), (Some(0.0), 0), (Some(0.5), 1)].map(|(g, k)| (g, &expected[k]))
            {
                let prompts = Prompts { points: points.clone(), granularity, ..Prompts::default() };
                is(&all.segmenter.segment(&image, &prompts).unwrap(), expected, what);
            }
        }
    }
}

#[test]
fn the_embedding_covers_the_whole_photo_in_the_numbers_of_each_family() {
    if !can_run("the_embedding_covers_the_whole_photo_in_the_numbers_of_each_family") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for (what, e) in EXPORTS {
        let all = pair(&folder.path().join(what), &e);
        let found = all.embedder.embed(&photo(SIZES[0])).unwrap();
        let n = e.grid[0] as usize;
        // No row is padding: a photo that is scaled by its long side would have fewer rows.
        assert_eq!([found.width, found.height, found.channels], [n, n, 256], "{what}");
        let (mean, deviation) = match n {
            72 => ([127.5; 3], [127.5; 3]),
            _ => ([123.675, 116.28, 103.53], [58.395, 57.12, 57.375]),
        };
        for ([x, y], colour) in
            [([2.0, 2.0], [0.8, 0.2, 0.2]), ([4.0, 5.5], [0.1, 0.2, 0.9]), ([7.99, 7.99], [0.5, 0.5, 0.5])]
        {
            let (column, row) = ((x * n as f32 / 8.0) as usize, (y * n as f32 / 8.0) as usize);
            for c in 0..3 {
                let expected = (255.0 * colour[c] - mean[c]) / deviation[c];
                let got = found.data[(c * n + row) * n + column];
                assert!((got - expected).abs() < 0.03, "{what} {x} {y} {c}: {got} is not {expected}");
            }
        }
    }
}

#[test]
fn clicks_outside_and_boxes_arrive_in_the_stretched_square() {
    if !can_run("clicks_outside_and_boxes_arrive_in_the_stretched_square") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for (what, e) in EXPORTS {
        let (size, image) = (SIZES[0], photo(SIZES[0]));
        let all = pair(&folder.path().join(what), &e);
        let ask = |points: Vec<PointPrompt>, boxes: Vec<BoxPrompt>| {
            all.segmenter.segment(&image, &Prompts { points, boxes, granularity: None }).unwrap()
        };
        let red = click(size, [2.0, 2.0], true);
        let one = ask(vec![red, click(size, [6.0, 2.0], false)], vec![]);
        is(&one, &truth(size, &[RED]), what);
        let left = corners(size, [0.5, 4.0, 0.5, 3.5]);
        is(&ask(vec![red], vec![left]), &truth(size, &[RED]), what);
        let bar = corners(size, BLUE.map(|n| n as f32));
        is(&ask(vec![], vec![bar]), &truth(size, &[BLUE]), what);
        is(&ask(vec![red], vec![left, bar]), &truth(size, &[RED, BLUE]), what);
        // A rough mask snaps to the rectangle below it.
        let rough = truth(size, &[RED]);
        let data = (0..image.pixels()).map(|i| if rough.index(i) { 0.9 } else { 0.1 }).collect();
        let certainty = Image { width: size[0], height: size[1], channels: 1, data };
        is(&all.segmenter.refine(&image, &certainty).unwrap(), &rough, what);
    }
}

#[test]
fn several_clicks_take_the_first_of_four_masks_and_go_on_from_the_answer_before() {
    if !can_run("several_clicks_take_the_first_of_four_masks_and_go_on_from_the_answer_before") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (size, image) = (SIZES[0], photo(SIZES[0]));
    let clicks =
        [click(size, [2.0, 2.0], true), click(size, [4.0, 5.5], true), click(size, [6.0, 2.0], false)];
    for (what, e, score, runs) in [
        // Each click is a run, on top of the answer before it.
        ("sam-cpp-macos", SAM_CPP, 0.99, 3),
        ("samexporter", SAMEXPORTER, 0.95, 3),
        // This one takes no earlier answer.
        ("Transformers", TRANSFORMERS, 0.95, 1),
    ] {
        let all = pair(&folder.path().join(what), &e);
        let prompts = Prompts { points: clicks.to_vec(), ..Prompts::default() };
        let answer = all.segmenter.segment(&image, &prompts).unwrap();
        is(&answer, &truth(size, &[RED, BLUE]), what);
        let work = all.proposer.work().unwrap();
        assert_eq!((answer.predicted_iou, work.encoded, work.prompts), (score, 1, runs), "{what}");
    }
}

#[test]
fn the_finer_maps_are_handed_over_as_they_are() {
    if !can_run("the_finer_maps_are_handed_over_as_they_are") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for (what, e) in EXPORTS {
        let prompts = Prompts { points: vec![click(SIZES[0], [2.0, 2.0], true)], ..Prompts::default() };
        let inside = |all: Providers| all.segmenter.segment(&photo(SIZES[0]), &prompts).unwrap().mask.count();
        assert!(inside(pair(&folder.path().join(what), &e)) > 0, "{what}");
        // The decoder compares them with the embedding: rows in the place of columns leave nothing.
        let other = folder.path().join(format!("{what}, turned"));
        toy::write(&other, "sam2.1_hiera_tiny", &encoder(&ToyExport { turned: true, ..e }), &decoder(&e));
        assert_eq!(inside(providers(&other)), 0, "{what}");
    }
}

#[test]
fn numbers_of_16_bits_give_the_same_masks() {
    if !can_run("numbers_of_16_bits_give_the_same_masks") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (size, image) = (SIZES[0], photo(SIZES[0]));
    for (what, e) in [("samexporter", SAMEXPORTER), ("Transformers", TRANSFORMERS)] {
        let prompts = Prompts { points: vec![click(size, [2.0, 2.0], true)], ..Prompts::default() };
        let answer = |all: Providers| all.segmenter.segment(&image, &prompts).unwrap();
        let whole = answer(pair(&folder.path().join(what), &e));
        let half = answer(pair(&folder.path().join(format!("{what}, halved")), &halved(e)));
        assert!(half.mask.iou(&whole.mask) > 0.98, "{what}");
        assert!((half.predicted_iou - whole.predicted_iou).abs() < 1e-3, "{what}");
    }
}

#[test]
fn sam_by_transformers_takes_clicks_and_says_that_it_takes_no_boxes() {
    if !can_run("sam_by_transformers_takes_clicks_and_says_that_it_takes_no_boxes") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let e = SAM_TRANSFORMERS;
    std::fs::write(folder.path().join("vision_encoder.onnx"), encoder(&e)).unwrap();
    std::fs::write(folder.path().join("prompt_encoder_mask_decoder.onnx"), decoder(&e)).unwrap();
    let all = providers(folder.path());
    assert!(all.notes.iter().any(|note| note.starts_with("SAM: SAM `vision`")), "{:?}", all.notes);
    let (size, image) = (SIZES[0], photo(SIZES[0]));
    // Scaled by its long side, as SAM is: 96 of 160 pixels are 38.4 of 64 rows.
    let found = all.embedder.embed(&image).unwrap();
    assert_eq!([found.width, found.height], [64, 38]);
    let red = click(size, [2.0, 2.0], true);
    let prompts = Prompts { points: vec![red], ..Prompts::default() };
    is(&all.segmenter.segment(&image, &prompts).unwrap(), &truth(size, &[RED, REDDISH]), "a click");
    let boxed = Prompts { boxes: vec![corners(size, [0.5, 4.0, 0.5, 3.5])], ..prompts };
    match all.segmenter.segment(&image, &boxed) {
        Err(VisionError::Sam { file, reason }) => {
            assert_eq!(*reason, SamFileError::NoBoxes);
            assert!(file.ends_with("prompt_encoder_mask_decoder.onnx"), "{}", file.display());
        }
        other => panic!("{other:?}"),
    }
    // A rough mask is sent as a click in its middle.
    let rough = truth(size, &[BLUE]);
    let data = (0..image.pixels()).map(|i| if rough.index(i) { 0.9 } else { 0.1 }).collect();
    let certainty = Image { width: size[0], height: size[1], channels: 1, data };
    is(&all.segmenter.refine(&image, &certainty).unwrap(), &rough, "a rough mask");
}
