//! Time and memory of LPIPS on two images of a formula: `lpips_cost WEIGHTS.safetensors WIDTH HEIGHT [ROUNDS]`.
//!
//! Prints the distance and one over-all number of the gradient, to be compared with those of other programs.

use segwild_nn::{Lpips, Map};
use std::time::Instant;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [file, width, height, rounds @ ..] = arguments.as_slice() else {
        return eprintln!("lpips_cost WEIGHTS.safetensors WIDTH HEIGHT [ROUNDS]");
    };
    let number = |text: &String| text.parse::<usize>().expect("a number");
    let (width, height, rounds) = (number(width), number(height), rounds.first().map_or(3, number));
    let lpips =
        Lpips::parse(&std::fs::read(file).expect("the file")).unwrap_or_else(|e| panic!("{file}: {e}"));
    let image = |mixed: bool| {
        let value = |k: usize| {
            let (c, y, x) = (k / (width * height), k / width % height, k % width);
            let (c, y, x) = (c as f64, y as f64, x as f64);
            let wave = 0.5 + 0.4 * (0.37 * x + 0.11 * y * (c + 1.0)).sin();
            (if mixed { 0.9 * wave + 0.05 + 0.1 * (1.3 * x - 0.7 * y).sin() } else { wave }) as f32
        };
        Map { channels: 3, height, width, data: (0..3 * width * height).map(value).collect() }
    };
    let (render, target) = (image(false), image(true));
    let before = peak_mib();
    let distance = lpips.distance(&render, &target).expect("the images are large enough");
    let began = Instant::now();
    for _ in 0..rounds {
        assert_eq!(lpips.distance(&render, &target), Some(distance));
    }
    let forward = began.elapsed().as_secs_f64() / rounds.max(1) as f64;
    let without = peak_mib();
    let (_, grad) = lpips.gradient(&render, &target).expect("they still are");
    let began = Instant::now();
    for _ in 0..rounds {
        lpips.gradient(&render, &target);
    }
    let backward = began.elapsed().as_secs_f64() / rounds.max(1) as f64;
    let sum: f64 = grad.data.iter().map(|g| f64::from(g.abs())).sum();
    println!(
        "{} {width}x{height}: distance {distance:.9} in {forward:.3} s, with gradient (sum {sum:.6e}) in {backward:.3} s; \
         peak MiB: {before} before, {without} after distances, {} after gradients",
        lpips.net(),
        peak_mib()
    );
}

/// Most memory that the process had so far, in MiB; 0 where the system does not say.
fn peak_mib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.trim().trim_end_matches(" kB").parse::<u64>().ok()).unwrap_or(0) / 1024
}
