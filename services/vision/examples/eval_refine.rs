//! How well a rough selection is snapped to the photo: true masks are spoiled as a guess carried over from other photos
//! is, and given to `refine`.
//!
//! `cargo run -p segwild-vision --example eval_refine -- DIR [--every 2] [--skip 1] [--long 320] [--object NAME]
//! [--models DIR]`; DIR is a synthetic set or a folder with `images` and `truth/STEM.png`, as `liberty`.

#[allow(dead_code, reason = "the examples share it, none uses all of it")]
mod common;

use common::{ExampleResult, cpu, mean, option, photos_with_truth, provider};
use segwild_scene::{Image, Mask};
use segwild_vision::PromptSegmenter;
use std::path::PathBuf;

/// Ways to spoil a mask.
const WAYS: [&str; 9] =
    ["true", "soft", "quarter", "eighth", "shifted", "eroded", "dilated", "pierced", "all of it"];

/// A certainty from signed distances to the outline (inside positive), `soft` pixels wide.
fn soft(signed: &[f32], width: usize, by: f32, moved: f32) -> Image {
    let data = signed.iter().map(|d| 1.0 / (1.0 + (-(d + moved) / by).exp())).collect();
    Image { width, height: signed.len() / width, channels: 1, data }
}

fn shifted(image: &Image, dx: isize, dy: isize) -> Image {
    let (w, h) = (image.width as isize, image.height as isize);
    let at = |i: isize| {
        let (x, y) = ((i % w - dx).clamp(0, w - 1), (i / w - dy).clamp(0, h - 1));
        image.data[(y * w + x) as usize]
    };
    Image { data: (0..w * h).map(at).collect(), ..image.clone() }
}

/// The mask as seen on a grid `n` times as coarse.
fn coarse(truth: &Image, n: usize) -> Image {
    let (w, h) = (truth.width, truth.height);
    truth.resized(w.div_ceil(n), h.div_ceil(n)).resized(w, h)
}

/// Holes and blobs, `radius` pixels wide, at places that depend on nothing else.
fn pierced(image: &Image, radius: f32) -> Image {
    let mut out = image.clone();
    for i in 0..out.data.len() {
        let (x, y) = ((i % image.width) as f32, (i / image.width) as f32);
        let cell = 6.0 * radius;
        let (cx, cy) = ((x / cell).floor(), (y / cell).floor());
        let (mx, my) = ((cx + 0.5) * cell, (cy + 0.5) * cell);
        if (x - mx).powi(2) + (y - my).powi(2) < radius * radius {
            let turned = (cx as i64 * 7 + cy as i64 * 13) % 3;
            out.data[i] = match turned {
                0 => 0.2 * out.data[i],
                1 => out.data[i].max(0.7),
                _ => out.data[i],
            };
        }
    }
    out
}

fn spoiled(truth: &Mask) -> Vec<Image> {
    let (w, h) = (truth.width() as usize, truth.height() as usize);
    let (out, inn) = (truth.distances(), truth.not().distances());
    let signed: Vec<f32> =
        (0..w * h).map(|i| if truth.index(i) { inn[i] - 0.5 } else { 0.5 - out[i] }).collect();
    let hard = Image {
        width: w,
        height: h,
        channels: 1,
        data: (0..w * h).map(|i| f32::from(u8::from(truth.index(i)))).collect(),
    };
    let mut all = coarse(&hard, 4);
    all = pierced(&shifted(&all, 2, -1), 4.0);
    vec![
        hard.clone(),
        soft(&signed, w, 2.5, 0.0),
        coarse(&hard, 4),
        coarse(&hard, 8),
        shifted(&soft(&signed, w, 1.5, 0.0), 3, 2),
        soft(&signed, w, 1.5, -3.0),
        soft(&signed, w, 1.5, 3.0),
        pierced(&soft(&signed, w, 1.5, 0.0), 4.0),
        all,
    ]
}

fn main() -> ExampleResult<()> {
    let folder = PathBuf::from(std::env::args().nth(1).ok_or("name the folder of a set")?);
    let every: usize = option("--every").map_or(Ok(1), |t| t.parse())?;
    let skip: usize = option("--skip").map_or(Ok(0), |t| t.parse())?;
    let long: f32 = option("--long").map_or(Ok(320.0), |t| t.parse())?;
    let object = option("--object");
    let see = provider()?;
    let mut rows = vec![Vec::new(); WAYS.len()];
    let (mut seconds, mut count) = (0.0, 0);
    for photo in photos_with_truth(&folder, long)?.into_iter().skip(skip).step_by(every.max(1)) {
        let (image, truths) = photo.read()?;
        for (name, truth) in truths {
            if object.as_ref().is_some_and(|o| *o != name) || truth.count() * 200 < image.pixels() {
                continue;
            }
            for (row, certainty) in rows.iter_mut().zip(spoiled(&truth)) {
                let guess = Mask::over(truth.width(), truth.height(), &certainty.data, 0.5);
                let start = cpu();
                let snapped = see.refine(&image, &certainty)?.mask;
                seconds += cpu() - start;
                count += 1;
                row.push((guess.iou(&truth), snapped.iou(&truth)));
            }
        }
    }
    println!(
        "{} masks; CPU-s a refinement (the first of a photo with its analysis) {:.4}",
        rows[0].len(),
        seconds / f64::from(count.max(1))
    );
    for (way, row) in WAYS.iter().zip(&rows) {
        let of = |f: &dyn Fn(&(f64, f64)) -> f64| mean(&row.iter().map(f).collect::<Vec<_>>());
        let good: Vec<f64> = row.iter().filter(|r| r.0 > 0.8).map(|r| r.1 - r.0).collect();
        let worse = row.iter().filter(|r| r.1 < r.0 - 0.01).count();
        println!(
            "{way:<10} {:.3} -> {:.3}; of guesses over .8 ({}): {:+.3}; worse in {worse}",
            of(&|r| r.0),
            of(&|r| r.1),
            good.len(),
            mean(&good)
        );
    }
    Ok(())
}
