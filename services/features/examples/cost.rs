//! What a feature field costs: `cargo run -p segwild-features --example cost -- [splats] [channels] [size] [1: a learned
//! decoder]`.

use glam::Vec3;
use segwild_features::{Compression, FeatureSettings, Pca, Progress, ViewTarget, build};
use segwild_raster::{CpuEngine, ProjectOptions};
use segwild_scene::{Camera, Image, Mask, MaskSet, Pose, ScoredMask, Splats};
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

fn main() {
    let arguments: Vec<usize> = std::env::args().skip(1).map(|a| a.parse().expect("a number")).collect();
    let argument = |i: usize, default: usize| arguments.get(i).copied().unwrap_or(default);
    let (n, channels, size) = (argument(0, 30_000), argument(1, 64), argument(2, 64) as u32);
    let compression = if argument(3, 0) == 1 { Compression::Learned } else { Compression::Pca };
    let embedding_channels = 256;
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 40) as f32 / (1u64 << 23) as f32) - 1.0
    };
    let mut splats = Splats::default();
    for _ in 0..n {
        let p = Vec3::new(random(), random(), random());
        splats.means.push((p.normalize_or(Vec3::X) * 0.4).to_array());
        splats.log_scales.push([0.012f32.ln(); 3]);
        splats.rotations.push([1.0, 0.0, 0.0, 0.0]);
        splats.opacities.push(1.0);
        splats.sh.extend([0.0; 3]);
    }

    let samples: Vec<f32> = (0..50_000 * embedding_channels).map(|_| random()).collect();
    let start = Instant::now();
    let pca = Pca::fit(&samples, embedding_channels, channels, 1.0).expect("noise has components");
    println!("fit {embedding_channels} -> {} channels on 50000 cells: {:.2?}", pca.channels, start.elapsed());

    let camera = Camera { width: 320, height: 240, fx: 320.0, fy: 320.0, cx: 160.0, cy: 120.0 };
    let wide = if compression == Compression::Learned { embedding_channels } else { channels };
    let targets: Vec<Arc<ViewTarget>> = (0..20)
        .map(|k| {
            let angle = k as f32 / 20.0 * std::f32::consts::TAU;
            let eye = Vec3::new(angle.cos(), 0.3 * angle.sin(), angle.sin()) * 1.1;
            let data = (0..64 * 48 * wide).map(|_| random() / (wide as f32).sqrt()).collect();
            let masks = (0..60u32).map(|m| {
                let (x0, y0, side) = (m * 53 % 280, m * 31 % 200, 20 + m % 7 * 20);
                Mask::from_fn(320, 240, |x, y| x >= x0 && x < x0 + side && y >= y0 && y < y0 + side)
            });
            let scored = |mask| ScoredMask { mask, predicted_iou: 1.0, stability: 1.0 };
            Arc::new(ViewTarget {
                name: format!("view {k}"),
                camera,
                pose: Pose::look_at(eye, Vec3::ZERO, Vec3::NEG_Y),
                target: Image { width: 64, height: 48, channels: wide, data },
                validity: Image::filled(320, 240, 1, 1.0),
                masks: MaskSet { width: 320, height: 240, masks: masks.map(scored).collect() },
            })
        })
        .collect();
    let settings = FeatureSettings { feature_size: size, compression, ..FeatureSettings::default() };
    let engine = CpuEngine::new();
    let (start, mut lifted, mut first) = (Instant::now(), None, None);
    build(&engine, &splats, &&targets[..], &pca, &settings, &ProjectOptions::default(), &mut |p| {
        match p {
            Progress::Lifted { done: 20, .. } => lifted = Some(start.elapsed()),
            Progress::Refined { done, of, losses: Some(losses) } => {
                first.get_or_insert(losses);
                if done == of {
                    println!("{:?} -> {losses:?}", first.expect("set above"));
                }
            }
            _ => {}
        }
        ControlFlow::Continue(())
    })
    .expect("the targets fit");
    let lifted = lifted.expect("20 views");
    let refined = start.elapsed() - lifted;
    println!(
        "{n} splats x {channels} channels at {size} px: 20 views lifted in {lifted:.2?}, {} steps in {refined:.2?}",
        settings.refine_steps
    );
}
