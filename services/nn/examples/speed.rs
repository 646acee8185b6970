//! Times products and networks on this machine.

use segwild_nn::{Map, Strided, UNet, UNetShape, WeightLayout, product};
use std::time::Instant;

fn main() {
    for (rows, inner, columns, width) in
        [(16, 144, 128, 144), (64, 576, 128, 144), (512, 123, 64, 64), (512, 51, 3, 3)]
    {
        let (a, b) = (vec![0.5f32; rows * inner], vec![0.25f32; inner * width]);
        let mut out = vec![0.0f32; rows * columns];
        let rounds = 400_000_000 / (rows * inner * columns) + 1;
        let began = Instant::now();
        for _ in 0..rounds {
            let sizes = [rows, inner, columns];
            product(Strided::of(&a, inner), (&b, width), sizes, (&mut out, columns), false);
        }
        let seconds = began.elapsed().as_secs_f64();
        let flop = 2.0 * (rows * inner * columns * rounds) as f64;
        println!("product {rows} x {inner} x {columns}: {:.1} GFLOP/s", flop / seconds / 1e9);
    }
    let narrow = UNetShape {
        input: 4,
        stem: 3,
        encoder: [16, 16, 32, 48, 64],
        blocks: 1,
        decoder: [48, 32, 24, 24],
        beside: 10,
        output: 48,
        head: [32, 16, 16],
    };
    let paper = UNetShape {
        stem: 7,
        encoder: [64, 64, 128, 256, 512],
        blocks: 2,
        decoder: [256, 128, 64, 64],
        head: [256, 128, 64],
        ..narrow
    };
    for (name, shape, width, height) in
        [("narrow", narrow, 160, 128), ("paper", paper, 160, 128), ("paper", paper, 256, 192)]
    {
        let mut layout = WeightLayout::new();
        let net = UNet::new(&mut layout, ["net", "head"], &shape);
        let weights = layout.initial_weights(|| 0.5);
        let image = Map { channels: 4, height, width, data: vec![0.5; 4 * width * height] };
        let beside = Map::zeros(10, height / 2, width / 2);
        let (mut forward, mut backward) = (f64::MAX, f64::MAX);
        for _ in 0..5 {
            let began = Instant::now();
            let tape = net.forward(&weights, image.clone(), beside.clone());
            let half = began.elapsed().as_secs_f64();
            let mut sums = vec![0.0; layout.len()];
            net.backward(&weights, &tape, tape.of(net.maps).clone(), None, &mut sums);
            forward = forward.min(half);
            backward = backward.min(began.elapsed().as_secs_f64() - half);
        }
        let (forward, backward) = (1e3 * forward, 1e3 * backward);
        let weights = layout.len();
        println!(
            "{name}, {width} x {height}: {weights} weights, forward {forward:.1} ms, backward {backward:.1} ms"
        );
    }
}
