//! Faults planted in the kernels of training, each of which [`segwild_gpu::check`] lays to the kernel that has it. Those of
//! projection and drawing are in `parity.rs`, whose comparisons must see them as well.

mod common;

use common::{broken, engine, is_laid_to};
use segwild_gpu::Choice;

/// The same of the kernels of training, which only [`check`] sees.
const TRAINING_FAULTS: &[(&str, &str, &str)] = &[
    ("select", "parent.x * job.y + lane", "parent.x * job.y"),
    ("select", "parent.y == 1u", "parent.y == 2u"),
    ("select", "lane < job.w", "lane <= job.w"),
    ("shade", "colour += b[k]", "colour += 0.9 * b[k]"),
    ("tint", "codes[at + 1u]", "codes[at]"),
    ("tint_backward", "g[k] * own", "0.9 * g[k] * own"),
    ("tint_backward", "codes[6u * i + k - 3u]", "codes[6u * i]"),
    ("tint_backward", "= g[c] * photo.vector[2u * c + 1u]", "= g[c] * photo.vector[2u * c]"),
    ("tint_backward", "back += g[c] * photo", "back += photo"),
    ("observe", "before.z + 1.0", "before.z"),
    ("observe", "view.frame.x + u32(splat.z)", "view.frame.x + u32(splat.w)"),
    ("adam", "sqrt(held)", "held"),
    ("adam", "lane >= rules.item.w", "lane > rules.item.w"),
    ("adam", "rule.beta2 * second[k]", "rule.beta1 * second[k]"),
    ("shade_backward", "= b[k] * g.y", "= b[k] * g.x"),
    ("shade_backward", "direction.xyz * dot(d", "0.5 * direction.xyz * dot(d"),
];

/// Faults in the kernels of the photo's half of a step.
const COMPARISON_FAULTS: &[(&str, &str, &str)] = &[
    ("compose", "(1.0 - drawn.w) * behind", "behind"),
    ("compose", "doubt = 1.0 - trust[i]", "doubt = 1.0 - 0.1 * trust[i]"),
    ("compose", "dot(sitting.matrix[c], scene)", "dot(sitting.matrix[c].xyz, scene.xyz)"),
    ("box_mean", "at + job.z + 1u", "at + job.z"),
    ("box_mean", "if job.w == 1u", "if job.w == 2u"),
    ("tally", "has(photo[i], COUNTS)", "has(photo[i], SKY)"),
    ("limits", "DECAY * before[b]", "before[b]"),
    ("limits", "CONTRAST * quantile(of_held, 0.5)", "9.0 * quantile(of_held, 0.5)"),
    ("limits", "limit = max(limit, threshold(false, share));", ""),
    ("limits", "SUSPECTED * limit", "limit"),
    ("weigh", "select(0u, 1u, has(pixel, SUSPECT))", "0u"),
    ("weigh", "2u * votes >", "votes >"),
    ("weigh", "weight * dot(lack, lack)", "dot(lack, lack)"),
    ("weigh", "counted[i] = weight * shown[i].w", "counted[i] = shown[i].w"),
    ("structure", "2.0 * (m.w - product)", "2.0 * m.w"),
    ("structure", "along[middle - tap * TILE] +", "along[middle] +"),
    ("structure", "by_squares = -ssim", "by_squares = ssim"),
    ("slope", "f32(d > 0.0) - f32(d < 0.0)", "f32(d > 0.0)"),
    ("slope", "2.0 * x * by.y", "x * by.y"),
    ("slope", "y * by.z", "x * by.z"),
    ("grade", "g.y * sitting.matrix[1].xyz", "g.y * sitting.matrix[2].xyz"),
    ("grade", "-dot(by_scene, back)", "dot(by_scene, back)"),
    ("grade", "drawn.w, LEAST_OPEN", "drawn.w, 0.95"),
    ("grade", "g[c] * scene", "g[0] * scene"),
    ("sky_sums", "seen[p][12] * seen[p][a]", "seen[p][a]"),
    ("sky_sums", "open * open * weights[i]", "open * weights[i]"),
    ("sky_sums", "9u + (local - PRODUCTS) % 3u", "9u"),
    ("colour_sums", "* open * vec4f", "* vec4f"),
    ("total", "parts[k * job.y + column]", "parts[k * job.y]"),
];

#[test]
fn a_fault_in_any_kernel_of_training_is_seen() {
    let Some(gpu) = engine("a_fault_in_any_kernel_of_training_is_seen") else { return };
    let choice = Choice::Named(gpu.adapter().name.clone());
    for &(kernel, text, fault) in TRAINING_FAULTS {
        is_laid_to(&broken(&choice, kernel, text, fault), kernel, fault);
    }
}

#[test]
fn a_fault_in_any_kernel_of_a_photos_comparison_is_seen() {
    let Some(gpu) = engine("a_fault_in_any_kernel_of_a_photos_comparison_is_seen") else { return };
    let choice = Choice::Named(gpu.adapter().name.clone());
    for &(kernel, text, fault) in COMPARISON_FAULTS {
        is_laid_to(&broken(&choice, kernel, text, fault), kernel, fault);
    }
}
