//! How fast a pair of the SAM family is here: seconds per photo encoded, prompts per second.
//!
//! `cargo run --release -p segwild-vision --example bench_sam -- MODELS [STEM] [THREADS] [auto|cpu|cuda]`; without a folder
//! of models, or with one that does not exist yet, small networks of SAM's interface are made there, which measure all but
//! the networks.

#[path = "../tests/it/toy/mod.rs"]
mod toy;

use segwild_scene::settings::Value;
use segwild_scene::{Image, Prompts};
use segwild_vision::{DeviceChoice, ModelChoice, Providers, VisionSettings, Work};
use std::error::Error;
use std::time::Instant;

/// Photos that are encoded.
const PHOTOS: usize = 5;
/// Prompts along a side of the grid on the first of them.
const GRID: usize = 16;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let (models, stem) = (args.next(), args.next().unwrap_or_default());
    let threads = args.next().map_or(Ok(1), |n| n.parse())?;
    let device = args.next().map_or(Ok(DeviceChoice::Auto), |word| DeviceChoice::read(&word))?;
    let made = tempfile::tempdir()?;
    let models = models.unwrap_or_else(|| made.path().join("models").display().to_string());
    if !std::path::Path::new(&models).exists() {
        toy::write_usual(models.as_ref());
    }
    let began = Instant::now();
    let all = Providers::from_settings(&VisionSettings {
        models,
        sam: stem,
        masks: ModelChoice::Sam,
        embedder: ModelChoice::Sam,
        network_threads: threads,
        network_device: device,
        ..VisionSettings::default()
    })?;
    all.notes.iter().filter(|n| n.starts_with("SAM")).for_each(|n| println!("{n}"));
    println!("loaded in {:.2} s; {threads} threads", began.elapsed().as_secs_f64());
    let photos: Vec<Image> = (0..PHOTOS).map(photo).collect();
    for photo in &photos {
        all.embedder.embed(photo)?;
    }
    let work = |since: Work| {
        let now = all.proposer.work().unwrap_or_default();
        Work {
            encoded: now.encoded - since.encoded,
            encode_s: now.encode_s - since.encode_s,
            prompts: now.prompts - since.prompts,
            decode_s: now.decode_s - since.decode_s,
        }
    };
    let encoded = work(Work::default());
    println!("{} photos encoded, {:.3} s each", encoded.encoded, encoded.seconds_per_image().unwrap_or(0.0));
    // The first one is still in memory.
    let (w, h) = (photos[0].width as f32, photos[0].height as f32);
    let at = |k: usize, size: f32| (k as f32 + 0.5) * size / GRID as f32;
    let points: Vec<[f32; 2]> = (0..GRID * GRID).map(|i| [at(i % GRID, w), at(i / GRID, h)]).collect();
    let before = work(Work::default());
    let masks = all.proposer.propose(&photos[0], &points)?;
    let prompted = work(before);
    println!(
        "{} prompts, {} masks of {w} x {h}: {:.1} prompts per second",
        prompted.prompts,
        masks.len(),
        prompted.prompts_per_second().unwrap_or(0.0)
    );
    let began = Instant::now();
    all.segmenter.segment(&photos[0], &Prompts::click(0.4 * w, 0.4 * h))?;
    println!("a click on a photo that is known: {:.1} ms", 1000.0 * began.elapsed().as_secs_f64());
    Ok(())
}

/// A photo of the program's usual size: a grid of colours, another one each time.
fn photo(k: usize) -> Image {
    let (w, h) = (640, 427);
    let mut image = Image::zeros(w, h, 3);
    for (i, v) in image.data.iter_mut().enumerate() {
        let (c, x, y) = (i / (w * h), i % w, i / w % h);
        *v = ((x / 64 * 37 + y / 61 * 53 + c * 29 + k * 11) % 97) as f32 / 97.0;
    }
    image
}
