//! The built-in provider on drawn photos whose answer is known, and on input that nobody should give.

use proptest::prelude::*;
use segwild_scene::{BoxPrompt, Image, Mask, PointPrompt, Prompts};
use segwild_vision::{Builtin, Embedder, MaskProposer, PromptSegmenter, SkyDetector};

/// Repeatable noise in [-1, 1] per pixel.
fn noise(x: usize, y: usize, c: usize) -> f32 {
    let mut v = (x * 374_761_393 + y * 668_265_263 + c * 2_147_483_647) as u32;
    v = (v ^ (v >> 13)).wrapping_mul(1_274_126_177);
    ((v ^ (v >> 16)) & 0xffff) as f32 / 32767.5 - 1.0
}

/// A blue sky that pales towards the horizon, a grass field, and an ochre tower of two parts in front of both.
fn tower(w: usize, h: usize, light: f32) -> (Image, Mask, Mask) {
    let inside = |x: u32, y: u32, x0: f32, y0: f32, x1: f32, y1: f32| {
        let (u, v) = ((x as f32 + 0.5) / w as f32, (y as f32 + 0.5) / h as f32);
        u >= x0 && u < x1 && v >= y0 && v < y1
    };
    let top = Mask::from_fn(w as u32, h as u32, |x, y| inside(x, y, 0.42, 0.15, 0.58, 0.5));
    let base = Mask::from_fn(w as u32, h as u32, |x, y| inside(x, y, 0.36, 0.5, 0.64, 0.85));
    let mut image = Image::zeros(w, h, 3);
    for y in 0..h {
        for x in 0..w {
            let v = y as f32 / h as f32;
            let i = (x as u32, y as u32);
            let colour = if top.get(i.0, i.1) {
                [0.75, 0.55, 0.25]
            } else if base.get(i.0, i.1) {
                [0.45, 0.28, 0.2]
            } else if v < 0.65 {
                [0.35 + 0.4 * v, 0.55 + 0.3 * v, 0.9]
            } else {
                let blade = 0.1 * noise(x / 2, y / 2, 9);
                [0.25 + blade, 0.42 + blade, 0.15 + blade]
            };
            for c in 0..3 {
                image.data[(c * h + y) * w + x] =
                    (light * colour[c] + 0.015 * noise(x, y, c)).clamp(0.0, 1.0);
            }
        }
    }
    (image, top, base)
}

#[test]
fn a_click_gives_the_part_and_two_clicks_the_whole() {
    let (image, top, base) = tower(240, 180, 1.0);
    let see = Builtin::new();
    let one = see.segment(&image, &Prompts::click(120.0, 60.0)).unwrap();
    assert!(one.mask.iou(&top) > 0.93, "one click: {}", one.mask.iou(&top));
    let click = |x, y, inside| PointPrompt { x, y, inside };
    let both =
        Prompts { points: vec![click(120.0, 60.0, true), click(120.0, 120.0, true)], ..Prompts::default() };
    let whole = see.segment(&image, &both).unwrap();
    assert!(whole.mask.iou(&top.or(&base)) > 0.93, "two clicks: {}", whole.mask.iou(&top.or(&base)));
    // The coarsest level takes in more than one part; a negative click there takes it out again.
    let coarse = Prompts { granularity: Some(1.0), ..Prompts::click(120.0, 60.0) };
    let all = see.segment(&image, &coarse).unwrap().mask;
    assert!(all.count() >= one.mask.count());
    let without = Prompts { points: vec![click(120.0, 60.0, true), click(120.0, 120.0, false)], ..coarse };
    let split = see.segment(&image, &without).unwrap().mask;
    assert!(split.at(120.0, 60.0) && !split.at(120.0, 120.0));
    let fine = Prompts { granularity: Some(0.0), ..Prompts::click(120.0, 60.0) };
    assert!(see.segment(&image, &fine).unwrap().mask.minus(&all).is_empty(), "levels nest");
}

/// A block before a wall, its right half in a shade: the photo, and both halves.
fn half_shaded(shade: f32) -> (Image, Mask, Mask) {
    let part = |x0, x1| Mask::from_fn(240, 180, |x, y| (x0..x1).contains(&x) && (50..130).contains(&y));
    let (lit, shaded) = (part(70, 125), part(125, 170));
    let mut image = Image::zeros(240, 180, 3);
    for i in 0..240 * 180 {
        let (x, y) = (i % 240, i / 240);
        let (colour, light) = if lit.index(i) {
            ([0.75, 0.6, 0.35], 1.0)
        } else if shaded.index(i) {
            ([0.75, 0.6, 0.35], shade)
        } else {
            ([0.45, 0.5, 0.6], 1.0)
        };
        for (c, colour) in colour.iter().enumerate() {
            image.data[c * 240 * 180 + i] = (light * colour + 0.03 * noise(x, y, c)).clamp(0.0, 1.0);
        }
    }
    (image, lit, shaded)
}

#[test]
fn what_a_click_may_also_have_meant_is_left_open_until_somebody_says_no() {
    let (image, lit, shaded) = half_shaded(0.65);
    let wall = lit.or(&shaded).not();
    let see = Builtin::new();
    let ask = |points: &[(f32, f32, bool)]| {
        let points = points.iter().map(|&(x, y, inside)| PointPrompt { x, y, inside }).collect();
        let found = see.prompted(&image, &Prompts { points, ..Prompts::default() }).unwrap();
        let (mask, open) = (found.answer.mask, found.open);
        assert_eq!((open.width, open.height, open.channels), (240, 180, 1));
        assert!((0..open.pixels()).all(|i| open.data[i] == 0.0 || !mask.index(i)), "open inside the mask");
        let mean = |part: &Mask| {
            let sum: f32 = part.pixels().map(|(x, y)| open.at(0, x as usize, y as usize)).sum();
            sum / part.count() as f32
        };
        (mean(&shaded), mean(&wall), mask)
    };
    let (on_shaded, on_wall, mask) = ask(&[(100.0, 90.0, true)]);
    assert!(mask.iou(&lit) > 0.95, "{}", mask.iou(&lit));
    assert!(on_shaded > 0.2 && on_wall < 0.02, "{on_shaded} {on_wall}");
    let (on_shaded, _, mask) = ask(&[(100.0, 90.0, true), (150.0, 90.0, false)]);
    assert!(mask.iou(&lit) > 0.95 && on_shaded == 0.0, "refused: {on_shaded}");
    let (_, _, mask) = ask(&[(100.0, 90.0, true), (150.0, 90.0, true)]);
    assert!(mask.iou(&lit.or(&shaded)) > 0.95, "both: {}", mask.iou(&lit.or(&shaded)));
}

#[test]
fn a_box_gives_what_it_holds() {
    let (image, top, base) = tower(240, 180, 1.0);
    let b = BoxPrompt { x0: 158.0, y0: 155.0, x1: 82.0, y1: 24.0 };
    let found = Builtin::new().segment(&image, &Prompts { boxes: vec![b], ..Prompts::default() }).unwrap();
    let truth = top.or(&base);
    assert!(found.mask.iou(&truth) > 0.85, "box: {}", found.mask.iou(&truth));
}

#[test]
fn proposals_nest_and_find_the_part() {
    let (image, top, base) = tower(240, 180, 1.0);
    let see = Builtin::new();
    let found = see
        .propose(&image, &[[120.0, 60.0], [120.0, 61.0], [120.0, 120.0], [-5.0, 3.0], [f32::NAN, 1.0]])
        .unwrap();
    for truth in [&top, &base] {
        let best = found.iter().map(|m| m.mask.iou(truth)).fold(0.0, f64::max);
        assert!(best > 0.93, "best {best}");
    }
    for (i, m) in found.iter().enumerate() {
        assert!((0.0..=1.0).contains(&m.predicted_iou) && (0.0..=1.0).contains(&m.stability));
        assert!(found[..i].iter().all(|o| o.mask != m.mask), "given twice");
    }
    assert!(see.propose(&image, &[]).unwrap().is_empty());
}

#[test]
fn a_rough_selection_is_snapped_to_the_outline() {
    let (image, top, base) = tower(240, 180, 1.0);
    let truth = top.or(&base);
    let rough =
        truth.dilated(6.0).minus(&Mask::from_fn(240, 180, |x, y| x.abs_diff(118) < 6 && y.abs_diff(100) < 6));
    let soft = Image {
        width: 240,
        height: 180,
        channels: 1,
        data: (0..240 * 180).map(|i| if rough.index(i) { 0.8 } else { 0.1 }).collect(),
    };
    let snapped = Builtin::new().refine(&image, &soft).unwrap();
    assert!(
        rough.iou(&truth) < 0.85 && snapped.mask.iou(&truth) > 0.95,
        "{} -> {}",
        rough.iou(&truth),
        snapped.mask.iou(&truth)
    );
    let nothing = Builtin::new().refine(&image, &Image::zeros(240, 180, 1)).unwrap();
    assert!(nothing.mask.is_empty(), "no certainty anywhere: no object");
}

#[test]
fn sky_is_found_and_not_invented() {
    let (image, top, base) = tower(240, 180, 1.0);
    let see = Builtin::new();
    let sky = see.sky(&image).unwrap();
    let truth = Mask::from_fn(240, 180, |_, y| (y as f32) < 0.65 * 180.0).minus(&top.or(&base));
    assert!(sky.iou(&truth) > 0.93, "sky {}", sky.iou(&truth));
    // The same photo without its upper part: grass and bricks only.
    let mut wall = Image::zeros(240, 180, 3);
    for i in 0..240 * 180 {
        let (x, y) = (i % 240, i / 240);
        let brick = if y % 12 < 2 || (x + y / 12 * 7) % 24 < 2 { 0.75 } else { 0.35 + 0.1 * noise(x, y, 1) };
        for c in 0..3 {
            wall.data[c * 240 * 180 + i] = brick * [1.0, 0.62, 0.45][c];
        }
    }
    assert!(see.sky(&wall).unwrap().is_empty(), "a brick wall is no sky");
}

#[test]
fn descriptors_survive_another_light() {
    let unit = |e: &segwild_scene::Embedding, i: usize, centre: &[f32]| {
        let n = e.width * e.height;
        let v: Vec<f32> = (0..e.channels).map(|c| e.data[c * n + i] - centre[c]).collect();
        let norm = v.iter().map(|x| x * x).sum::<f32>().sqrt();
        v.into_iter().map(move |x| x / norm).collect::<Vec<f32>>()
    };
    let see = Builtin::new();
    let bright = see.embed(&tower(240, 180, 1.0).0).unwrap();
    let dark = see.embed(&tower(240, 180, 0.6).0).unwrap();
    assert_eq!((bright.width, bright.height), (64, 48));
    let n = bright.width * bright.height;
    let centre: Vec<f32> = (0..bright.channels)
        .map(|c| (0..n).map(|i| bright.data[c * n + i] + dark.data[c * n + i]).sum::<f32>() / (2 * n) as f32)
        .collect();
    let cell = |x: usize, y: usize| y * bright.width + x;
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>();
    let cells = [cell(32, 16), cell(32, 32), cell(8, 10), cell(8, 42)];
    for (k, &p) in cells.iter().enumerate() {
        let here = unit(&bright, p, &centre);
        for (m, &q) in cells.iter().enumerate() {
            let other = dot(&here, &unit(&dark, q, &centre));
            if k == m {
                assert!(other > 0.6, "place {k} in another light: {other}");
            } else {
                assert!(other < 0.5, "places {k} and {m}: {other}");
            }
        }
    }
}

#[test]
fn prompts_that_cannot_be_answered_are_refused() {
    let see = Builtin::new();
    let (image, ..) = tower(60, 40, 1.0);
    let text = |r: Result<segwild_scene::ScoredMask, segwild_vision::VisionError>| r.unwrap_err().to_string();
    assert!(text(see.segment(&image, &Prompts::click(60.5, 3.0))).contains("outside the photo (60 x 40)"));
    assert!(text(see.segment(&image, &Prompts::default())).contains("nothing says what is wanted"));
    let off = BoxPrompt { x0: 100.0, y0: 0.0, x1: 120.0, y1: 9.0 };
    assert!(
        text(see.segment(&image, &Prompts { boxes: vec![off], ..Prompts::default() })).contains("no pixel")
    );
    assert!(text(see.refine(&image, &Image::zeros(59, 40, 1))).contains("59 x 40"));
    assert!(see.embed(&Image::zeros(0, 5, 3)).unwrap_err().to_string().contains("it has none"));
    assert!(see.sky(&Image::zeros(8, 8, 1)).unwrap_err().to_string().contains("1 channels"));
    let short = Image { width: 8, height: 8, channels: 3, data: vec![0.0; 9] };
    assert!(see.embed(&short).unwrap_err().to_string().contains("holds 9 numbers"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Any size and any numbers, poison included: an answer of the right size or a sentence, and the same answer twice.
    #[test]
    fn any_photo_is_answered(
        w in 1usize..40,
        h in 1usize..40,
        seed in 0usize..1000,
        poison in prop::sample::select(vec![f32::NAN, f32::INFINITY, -1e30, 1e-40, 7.0]),
        x in -2f32..42.0,
        y in -2f32..42.0,
        level in prop::option::of(-1f32..2.0),
    ) {
        let mut image = Image::zeros(w, h, 3);
        for (i, v) in image.data.iter_mut().enumerate() {
            *v = if (i + seed).is_multiple_of(13) { poison } else { 0.5 + 0.5 * noise(i, seed, 0) };
        }
        let see = Builtin::new();
        let prompts = Prompts {
            points: vec![PointPrompt { x, y, inside: true }, PointPrompt { x: y, y: x, inside: false }],
            granularity: level,
            ..Prompts::default()
        };
        if let Ok(answer) = see.segment(&image, &prompts) {
            prop_assert_eq!((answer.mask.width(), answer.mask.height()), (w as u32, h as u32));
            prop_assert!(answer.mask.at(x, y));
            prop_assert_eq!(&Builtin::new().segment(&image, &prompts).unwrap(), &answer);
        }
        let embedding = see.embed(&image).unwrap();
        prop_assert!(embedding.data.iter().all(|v| v.is_finite()));
        prop_assert_eq!(embedding.data.len(), embedding.width * embedding.height * embedding.channels);
        prop_assert_eq!(see.sky(&image).unwrap().width(), w as u32);
        see.propose(&image, &[[x, y]]).unwrap();
        let plane = Image { width: w, height: h, channels: 1, data: image.plane(0).to_vec() };
        see.refine(&image, &plane).unwrap();
        let b = BoxPrompt { x0: x, y0: y, x1: 10.0, y1: 9.0 };
        if let Ok(answer) = see.segment(&image, &Prompts { boxes: vec![b], ..Prompts::default() }) {
            prop_assert_eq!(answer.mask.width(), w as u32);
            prop_assert!(!answer.mask.is_empty(), "a box always means something");
        }
    }
}

#[test]
fn a_photo_that_was_prepared_is_answered_alike() {
    let (image, top, _) = tower(96, 128, 1.0);
    let data = (0..image.pixels()).map(|i| f32::from(u8::from(top.index(i)))).collect();
    let certainty = Image { channels: 1, data, ..image.clone() };
    let answers = [1 << 30, 1].map(|bytes| {
        let provider = Builtin::new().within(bytes);
        // The second time it knows how much an analysis takes, and whether there is room.
        provider.prepare(&image);
        provider.prepare(&image);
        provider.refine(&image, &certainty).unwrap()
    });
    assert!(answers.iter().all(|answer| *answer == Builtin::new().refine(&image, &certainty).unwrap()));
}
