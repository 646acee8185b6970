//! Checks the kernels of the appearance model `gsw`: its networks on the device against those on the host.

use crate::kernel_check::KernelCheck;
use crate::tolerance::Tolerance;
use segwild_gpu::GpuEngine;
use segwild_gpu::GpuError;
use segwild_gpu::probe::{LightingPasses, LightingResults, UploadedNetworks, run_network};
use segwild_nn::{Conv, Form, Map, NetworkGraph, Op, OpKind, WeightLayout};
use segwild_objective::gsw::{BELOW, EMBEDDING_SIZE, LAYER, Networks};
use segwild_objective::{Appearance, GswAppearance, GswWidth, NetworksStep, Rule, VisibleSplats};
use segwild_raster::{CpuEngine, ProjectOptions, RasterError, Rasterizer};
use segwild_scene::{Camera, Pose, Random, Splats};

/// A photo of this size: more pixels at half of it than a slice of the weights' gradients has, and borders on all sides.
const PHOTO: (usize, usize) = (96, 64);
/// Splats of a piece: the scene has several, of which the last is not full.
const PIECE: usize = 200;

fn noise(random: &mut Random, n: usize) -> Vec<f32> {
    (0..n).map(|_| random.uniform() - 0.5).collect()
}

/// An appearance model with one photo of a camera.
fn appearance(camera: &Camera, pose: &Pose) -> GswAppearance {
    let mut appearance = GswAppearance::new(1, 31, GswWidth::Cpu);
    let (w, h) = PHOTO;
    let wave =
        |i: usize, c: usize| 0.5 + 0.4 * (0.2 * (i % w) as f32 + 0.13 * (i / w * (c + 1)) as f32).sin();
    let colour = |i: usize| (i % 7 != 3).then(|| [0, 1, 2].map(|c| wave(i, c)));
    let image_conditioning = appearance.image_conditioning((w, h), camera, pose, colour);
    appearance.set_image_conditioning(0, image_conditioning);
    // The last layer starts near 0, which would hide the layers before it.
    let random = &mut Random::new(32);
    let layer = noise(random, LAYER);
    appearance.set_layer(&layer);
    appearance.below.set_matrix(0, [0.9, 0.1, -0.05, 0.02, 0.05, 1.1, 0.1, -0.03, -0.1, 0.05, 0.8, 0.04]);
    appearance
}

/// A step that reads light, of the whole photo or a part.
fn draw_of(appearance: &GswAppearance, whole: bool) -> u64 {
    let is = |&draw: &u64| appearance.unet_input(0, draw).is_some_and(|unet_input| unet_input.whole == whole);
    (0..1000).find(is).expect("one in a thousand")
}

/// An appearance model `gsw` with one square photo of a camera, at the size of the UNet's input, and a step that reads
/// its light.
pub fn some_appearance(camera: &Camera, pose: &Pose) -> (GswAppearance, u64) {
    let mut appearance = GswAppearance::new(1, 1, GswWidth::Cpu);
    let side = Networks::of(GswWidth::Cpu).side;
    let colour = |i: usize| Some([i % side, i / side, 7].map(|n| n as f32 / side as f32));
    let image_conditioning = appearance.image_conditioning((side, side), camera, pose, colour);
    appearance.set_image_conditioning(0, image_conditioning);
    let draw =
        (0..1000).find(|&draw| appearance.unet_input(0, draw).is_some_and(|unet_input| unet_input.whole));
    (appearance, draw.expect("one in a thousand"))
}

/// Compares the networks of splats in sight of a camera, and of a photo.
pub fn networks(
    engine: &GpuEngine,
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
) -> Result<Vec<KernelCheck>, RasterError> {
    let appearance = appearance(camera, pose);
    let mut checked = small(engine)?;
    checked.extend(photo(engine, &appearance)?);
    for (name, draw) in [
        ("a photo", Some(draw_of(&appearance, true))),
        ("half a photo", Some(draw_of(&appearance, false))),
        ("no light", None),
    ] {
        let view = NetworkView { splats, camera, pose };
        let found = lighting(engine, &appearance, &view, draw)?;
        checked.extend(
            found
                .into_iter()
                .map(|checked| KernelCheck { off: checked.off.map(|off| off.of_case(name)), ..checked }),
        );
    }
    // Kernels without a difference are listed once.
    let mut fine: Vec<&[&str]> = Vec::new();
    checked.retain(|checked| {
        let first = !fine.contains(&checked.kernels);
        if checked.off.is_none() && first {
            fine.push(checked.kernels);
        }
        checked.off.is_some() || first
    });
    Ok(checked)
}

/// A network in which a map is read in ways that no [`UNet`](segwild_nn::UNet) has.
fn small(engine: &GpuEngine) -> Result<Vec<KernelCheck>, GpuError> {
    let mut layout = WeightLayout::new();
    let mut graph = NetworkGraph::given(&[Form { channels: 3, halved: 0 }]);
    let first = graph.conv(Conv::new(&mut layout, "first", [3, 40], 3, 1), 0, true);
    let second = graph.conv(Conv::new(&mut layout, "second", [40, 40], 1, 1), first, false);
    let joined = graph.sum([first, second], true);
    let all = graph.concat([joined, first]);
    let random = &mut Random::new(35);
    let weights = noise(random, layout.len());
    let image = Map { data: noise(random, 3 * 11 * 13), channels: 3, height: 11, width: 13 };
    network(engine, &graph, weights, vec![image], &[all])
}

/// The network of a photo.
fn photo(engine: &GpuEngine, appearance: &GswAppearance) -> Result<Vec<KernelCheck>, GpuError> {
    let unet = &Networks::of(GswWidth::Cpu).unet;
    let unet_input = appearance.unet_input(0, draw_of(appearance, true)).expect("there is light");
    let mut weights = appearance.training_networks().weights;
    // Norms start with factors that change nothing.
    let random = &mut Random::new(36);
    let changes = noise(random, weights.len());
    weights.iter_mut().zip(changes).for_each(|(weight, by)| *weight += 0.2 * by);
    let given = vec![unet_input.image, unet_input.beside];
    network(engine, &unet.graph, weights, given, &[unet.maps, unet.plane])
}

/// Compares a network with inputs of one height and width, or half of these: all its maps, and the gradients of all
/// layers from some of its outputs.
fn network(
    engine: &GpuEngine,
    graph: &NetworkGraph,
    weights: Vec<f32>,
    given: Vec<Map>,
    results: &[usize],
) -> Result<Vec<KernelCheck>, GpuError> {
    let random = &mut Random::new(33);
    let right = graph.forward(&weights, given.clone());
    let output_grad = |&id: &usize| {
        let data = noise(random, right.of(id).data.len());
        (id, Map { data, ..right.of(id).clone() })
    };
    let output_grads: Vec<(usize, Map)> = results.iter().map(output_grad).collect();
    let mut wanted = vec![0.0; weights.len()];
    graph.backward(&weights, &right, output_grads.clone(), &mut wanted);

    let run = run_network(engine, graph, &weights, &given, &output_grads)?;
    let got = &run.weight_grads;

    let mut checked = Vec::new();
    let ops = graph.ops();
    // Maps that only a norm reads are not kept on the host.
    let normed = |op: &Op| ops.iter().any(|next| matches!(next.what, OpKind::Norm(_)) && next.from == op.to);
    for op in ops.iter().filter(|op| !normed(op)) {
        let kernels: &[&str] = match op.what {
            OpKind::Conv(_) | OpKind::Up(_) => &["convolve"],
            OpKind::Norm(_) => &["norm", "convolve"],
            OpKind::Add(_) | OpKind::Concat(_) => &["add_maps"],
        };
        let map = &right.of(op.to).data;
        let got = run.map(op.to, map.len());
        let off = MAPS.compare(&format!("map {}", op.to), got, map).err();
        checked.push(KernelCheck { kernels, off });
    }
    for op in ops.iter().rev() {
        let (kernels, own): (&[&str], _) = match &op.what {
            OpKind::Conv(layer) => (
                &[
                    "convolve_weights",
                    "sum_weights",
                    "norm_backward",
                    "relu_backward",
                    "add_maps",
                    "convolve",
                ],
                layer.weights(),
            ),
            OpKind::Up(layer) => (
                &["convolve_weights", "sum_weights", "convolve", "add_maps", "relu_backward"],
                layer.weights(),
            ),
            OpKind::Norm(layer) => {
                (&["norm_backward", "relu_backward", "add_maps", "convolve"], layer.weights())
            }
            OpKind::Add(_) | OpKind::Concat(_) => continue,
        };
        let what = format!("gradients of the weights from {} on", own.start);
        let off = Tolerance::GRADIENTS.compare(&what, &got[own.clone()], &wanted[own]).err();
        checked.push(KernelCheck { kernels, off });
    }
    Ok(checked)
}

/// Tolerance for maps of a network, which are sums of sums.
const MAPS: Tolerance = Tolerance { tight: 1e-4, flips: 0.0, loose: 1e-3 };

struct NetworkView<'a> {
    splats: &'a Splats,
    camera: &'a Camera,
    pose: &'a Pose,
}

/// Compares the light of splats in a photo, forward and backward; `draw` is the step's random number; `None`: no light
/// is read.
fn lighting(
    engine: &GpuEngine,
    appearance: &GswAppearance,
    view: &NetworkView,
    draw: Option<u64>,
) -> Result<Vec<KernelCheck>, RasterError> {
    let NetworkView { splats, camera, pose } = *view;
    let n = splats.len();
    let random = &mut Random::new(34);
    let splat_embeddings: Vec<f32> = noise(random, n * EMBEDDING_SIZE).into_iter().map(|v| 8.0 * v).collect();
    let (colours, grad) = (noise(random, 3 * n), noise(random, 3 * n));
    let cpu = CpuEngine::new();
    let projected = cpu.project(splats, camera, pose, &ProjectOptions::default())?;
    let radii = projected.radii();
    let eye = pose.centre();
    let sight = VisibleSplats {
        means: &splats.means,
        splat_embeddings: &splat_embeddings,
        radii,
        eye: eye.to_array(),
    };
    let mut right = appearance.clone();
    let light = draw.and_then(|draw| right.appearance_maps(0, Some(draw)));
    let below = right.below.tint(0, &right.embeddings_below(&splat_embeddings), colours.clone());
    let tinted = right.tint(0, light.as_ref(), &sight, colours.clone());
    let map = light.as_ref().and_then(|light| light.visible());
    let part_residuals: Vec<Option<f32>> = map.map_or(Vec::new(), |map| {
        (0..map.pixels()).map(|i| (i % 5 != 1).then(|| 2.5 * random.uniform())).collect()
    });
    let (_, by_embedding) =
        right.tint_backward(0, light.as_ref(), &sight, &colours, grad.clone(), &part_residuals);
    let wanted = right.gradients().expect("kept for the next step").concat();

    let rules = [Rule { beta1: 0.9, beta2: 0.999, rate: 0.0, epsilon: 1e-8 }; 2];
    let unet_input = draw.and_then(|draw| appearance.unet_input(0, draw));
    let step = NetworksStep { unet_input, draw: draw.unwrap_or(0), decides: false, rules };
    let uploaded: Vec<f32> = part_residuals.iter().map(|residual| residual.unwrap_or(-1.0)).collect();
    let networks = UploadedNetworks::upload(engine, &appearance.training_networks())?;
    let known = (splats.means.as_slice(), radii);
    let passes = LightingPasses::upload(
        engine,
        &networks,
        &step,
        eye,
        known,
        (&splat_embeddings, &below),
        Some(PIECE),
    );
    let LightingResults { colours: shown, embedding_grads: by_device, weight_grads: weights } =
        passes?.results(&grad, (!uploaded.is_empty()).then_some(uploaded.as_slice()))?;

    let visible: Vec<usize> = (0..n).filter(|&i| radii[i] > 0.0).collect();
    let shown: Vec<f32> = visible.iter().flat_map(|&i| &shown[i][..3]).copied().collect();
    let tinted: Vec<f32> = visible.iter().flat_map(|&i| &tinted[3 * i..3 * i + 3]).copied().collect();
    let own = EMBEDDING_SIZE - BELOW;
    let embeddings_of = |splat_embeddings: &[f32]| -> Vec<f32> {
        visible
            .iter()
            .flat_map(|&i| &splat_embeddings[i * EMBEDDING_SIZE..i * EMBEDDING_SIZE + own])
            .copied()
            .collect()
    };
    let nets = Networks::of(GswWidth::Cpu);
    let border = nets.border;
    // Gradients of the visibility head are far smaller than the others.
    let layers = nets.layout.layers();
    let head =
        layers.iter().find(|layer| layer.name.starts_with("visible")).map_or(border, |l| l.weights.start);
    let compare =
        |what: &str, got: &[f32], wanted: &[f32]| Tolerance::GRADIENTS.compare(what, got, wanted).err();
    Ok(vec![
        KernelCheck {
            kernels: &["in_sight", "compact_in_sight", "gsw_inputs", "gsw_colours"],
            off: Tolerance::BLENDED.compare("tinted colours", &shown, &tinted).err(),
        },
        KernelCheck {
            kernels: &["gsw_colours_backward", "convolve_weights", "in_sight", "compact_in_sight"],
            off: compare("gradients of the small networks", &weights[border..], &wanted[border..]),
        },
        KernelCheck {
            kernels: &["gsw_inputs_backward"],
            off: compare(
                "gradients of the embeddings",
                &embeddings_of(&by_device),
                &embeddings_of(&by_embedding),
            ),
        },
        KernelCheck {
            kernels: &["map_sums", "gsw_inputs_backward", "visibility_gradient"],
            off: compare("gradients of the photo's network", &weights[..head], &wanted[..head]),
        },
        KernelCheck {
            kernels: &["visibility_gradient"],
            off: compare("gradients of its head", &weights[head..border], &wanted[head..border]),
        },
    ])
}
