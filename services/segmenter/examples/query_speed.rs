//! How long a click takes against reading the feature field once: `cargo run --example query_speed`.
//!
//! Prints, for 200 k splats x 64 channels, the time of a plain parallel sum over the numbers in 32 bits, of the fused
//! similarity to one, two and four clicks, and their ratio.

use rayon::prelude::*;
use segwild_raster::CpuEngine;
use segwild_segmenter::SplatFeatures;
use std::hint::black_box;
use std::time::Instant;

const SPLATS: usize = 200_000;
const CHANNELS: usize = 64;

/// The best of many runs, in milliseconds: what the machine can do when nothing else runs.
fn best(mut work: impl FnMut()) -> f64 {
    (0..40)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64() * 1e3
        })
        .fold(f64::INFINITY, f64::min)
}

fn read(values: &[f32]) -> f32 {
    let sums = values.par_chunks(2048 * CHANNELS).map(|chunk| {
        let mut lanes = [0.0f32; 64];
        for row in chunk.chunks_exact(64) {
            for (lane, x) in lanes.iter_mut().zip(row) {
                *lane += x;
            }
        }
        lanes.iter().sum::<f32>()
    });
    sums.sum()
}

fn main() -> Result<(), segwild_segmenter::SegmentError> {
    let mut state = 1u64;
    let values: Vec<f32> = (0..SPLATS * CHANNELS)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5
        })
        .collect();
    let field = SplatFeatures::new(CHANNELS, values)?;
    let values = field.values();
    let plain = best(|| {
        black_box(read(black_box(&values)));
    });
    let megabytes = (SPLATS * CHANNELS * 4) as f64 / 1e6;
    println!("reading {megabytes:.0} MB once: {plain:.2} ms ({:.1} GB/s)", megabytes / plain);
    for clicks in [1, 2, 4] {
        let ask: Vec<Vec<f32>> = (0..clicks).map(|c| field.row(c * 1000)).collect();
        field.similarity(&CpuEngine::new(), &ask, 0.1)?;
        let time = best(|| {
            black_box(field.similarity(&CpuEngine::new(), black_box(&ask), 0.1)).ok();
        });
        println!("{clicks} click(s): {time:.2} ms, {:.2} x the read", time / plain);
    }
    Ok(())
}
