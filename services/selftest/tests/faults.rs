//! Faults planted in the kernels of training. A stage of [`segwild_selftest::check`] must attribute each to the kernel that
//! has it. Faults of projection and blending are in `parity.rs`, whose comparisons must find them as well.

mod common;

use common::{KernelFault, are_laid_to, engine};
use segwild_selftest::{check_comparison, check_field, check_networks, check_splats};

/// Faults in the kernels of the splats' half of a step.
const TRAINING_FAULTS: &[KernelFault] = &[
    ("select", "parent.x * job.y + lane", "parent.x * job.y"),
    ("select", "parent.y == 1u", "parent.y == 2u"),
    ("select", "lane < job.w", "lane <= job.w"),
    ("shade", "colour += b[k]", "colour += 0.9 * b[k]"),
    ("tint", "splat_embeddings[at + 1u]", "splat_embeddings[at]"),
    ("tint_backward", "g[k] * own", "0.9 * g[k] * own"),
    ("tint_backward", "splat_embeddings[embedding + k - 3u]", "splat_embeddings[embedding]"),
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
const COMPARISON_FAULTS: &[KernelFault] = &[
    ("compose", "(1.0 - rendered.w) * background", "background"),
    ("compose", "uncertainty = 1.0 - trust[i]", "uncertainty = 1.0 - 0.1 * trust[i]"),
    ("compose", "dot(loss_inputs.matrix[c], scene)", "dot(loss_inputs.matrix[c].xyz, scene.xyz)"),
    ("box_mean", "at + job.z + 1u", "at + job.z"),
    ("box_mean", "if job.w == 1u", "if job.w == 2u"),
    ("tally", "has(photo[i], COUNTS)", "has(photo[i], SKY)"),
    ("limits", "DECAY * before[b]", "before[b]"),
    ("limits", "CONTRAST * quantile(of_held, 0.5)", "9.0 * quantile(of_held, 0.5)"),
    ("limits", "limit = max(limit, threshold(false, share));", ""),
    ("limits", "INITIAL_TRANSIENT_SHARE * limit", "limit"),
    ("weigh", "select(0u, 1u, has(pixel, INITIAL_TRANSIENT))", "0u"),
    ("weigh", "2u * votes >", "votes >"),
    ("weigh", "weight * dot(lack, lack)", "dot(lack, lack)"),
    ("weigh", "counted[i] = weight * shown[i].w", "counted[i] = shown[i].w"),
    ("structure", "2.0 * (m.w - product)", "2.0 * m.w"),
    ("structure", "along[middle - tap * TILE] +", "along[middle] +"),
    ("structure", "by_squares = -ssim", "by_squares = ssim"),
    ("slope", "f32(d > 0.0) - f32(d < 0.0)", "f32(d > 0.0)"),
    ("slope", "2.0 * x * by.y", "x * by.y"),
    ("slope", "y * by.z", "x * by.z"),
    ("grade", "g.y * loss_inputs.matrix[1].xyz", "g.y * loss_inputs.matrix[2].xyz"),
    ("grade", "-dot(by_scene, back)", "dot(by_scene, back)"),
    ("grade", "rendered.w, LEAST_OPEN", "rendered.w, 0.95"),
    ("grade", "g[c] * scene", "g[0] * scene"),
    ("sky_sums", "seen[p][12] * seen[p][a]", "seen[p][a]"),
    ("sky_sums", "open * open * weights[i]", "open * weights[i]"),
    ("sky_sums", "9u + (local - PRODUCTS) % 3u", "9u"),
    ("colour_sums", "* open * vec4f", "* vec4f"),
    ("total", "parts[k * job.y + column]", "parts[k * job.y]"),
];

/// Faults in the kernels of the appearance model `gsw`.
const NETWORK_FAULTS: &[KernelFault] = &[
    ("convolve", "taps - 1u - k % taps", "k % taps"),
    ("convolve", "seen % layer.gap != vec2u(0u)", "seen % layer.gap > vec2u(7u)"),
    ("convolve", "seen.x >= layer.in_width", "seen.x > layer.in_width"),
    ("convolve", "2u * pixel.x + plane % 2u", "2u * pixel.x"),
    ("convolve", "select(plane, plane / 4u", "select(plane, plane"),
    ("convolve", "max(made, 0.0)", "made"),
    ("convolve", "made += maps[position];", ""),
    ("convolve_weights", "min(capacity, in_sight - min(in_sight, first))", "min(capacity, in_sight)"),
    ("convolve_weights", "select(0.0, 1.0, k", "select(0.0, 0.9, k"),
    ("convolve_weights", "slice * job.w; start", "slice * 16u; start"),
    ("convolve_weights", "written(layer, plane, column", "written(layer, plane / 2u, column"),
    ("sum_weights", "slice < job.y", "slice + 1u < job.y"),
    ("sum_weights", "layer.offsets + plane / shared_by", "layer.offsets + plane"),
    ("norm", "off * off", "abs(off)"),
    ("norm", "+ EPSILON", "+ 1.0"),
    ("norm", "+ k / n;", ";"),
    ("norm_backward", "maps[layer.other + at] * means.y", "means.y"),
    ("norm_backward", "- means.x", ""),
    ("norm_backward", "+= sums.y", "+= sums.x"),
    ("join", "made += maps[layer.other + k];", ""),
    ("join", "made += maps[layer.writes + k];", ""),
    ("gate", "maps[at] > 0.0", "maps[at] > 0.5"),
    ("in_sight", "seen[i].y > 0.0", "seen[i].y >= 0.0"),
    ("pick", "splats[positions[i]] = i", "splats[positions[i]] = positions[i]"),
    ("read_light", "splat_embeddings[at + 1u]) * COORDINATE", "splat_embeddings[at + 1u]) * 0.2"),
    ("read_light", "far.y * near.x, far.y * far.x", "far.y * far.x, far.y * near.x"),
    ("read_light", "c = 1.0 - 2.0 * s * s", "c = 1.0 - s * s"),
    ("read_light", "mean - reader.eye.xyz", "mean"),
    ("read_light", "kept(reader, i, d)", "kept(reader, k, d)"),
    ("add_light", "points[at + job.x]", "points[at]"),
    ("take_light", "job.z + c * job.x + k", "job.z + k"),
    ("read_light_backward", "to_vector + to_light", "to_vector"),
    ("read_light_backward", "upper.y - upper.x", "upper.x - upper.y"),
    ("read_light_backward", "* spot.slope", ""),
    ("read_light_backward", "point_grads[here] = g", "point_grads[here] = 0.5 * g"),
    ("read_light_backward", "reader.frame.w * sign(at)", "-900.0 * reader.frame.w * sign(at)"),
    ("map_sums", "each.x * each.y", "each.x"),
    ("map_sums", "keys[middle] < key", "keys[middle] <= key"),
    ("map_sums", "grads[to] += sums[s]", "grads[to] = sums[s]"),
    ("visibility", "2.0 * (1.0 - v)", "(1.0 - v)"),
    ("visibility", "clamp(blames[k], 0.0, 2.0)", "blames[k]"),
    ("blame", "smoothed[i] / limits[2]", "smoothed[i] / limits[0]"),
    ("blame", "has(photo[i], COUNTS)", "has(photo[i], SKY)"),
    ("blame", "limits[2], WRONG)", "limits[2], 1.0)"),
    ("limits", "limits[2] = threshold(false, share)", "limits[2] = 2.0 * threshold(false, share)"),
    ("see", "/ (SURE - OCCLUDED)", "/ SURE"),
    ("see", "high.x, low.y", "low.x, low.y"),
    ("prefer", "counts * seen[i]", "seen[i]"),
    ("prefer", "own <= MOST * loss_inputs.numbers.z", "own <= 99.0 * loss_inputs.numbers.z"),
    ("prefer", "counted[i] = weight * shown[i].w", "counted[i] = shown[i].w"),
    ("prefer", "weight * dot(lack, lack)", "dot(lack, lack)"),
];

/// Faults in the kernels of the feature field.
const FIELD_FAULTS: &[KernelFault] = &[
    ("row_state", "!finite4(grad)", "false && !finite4(grad)"),
    ("row_state", "any(grad != vec4f(0.0))", "grad.x > 0.0"),
    ("row_step", "steps[i] + (job.w >> 31u)", "steps[i] + 1u"),
    ("row_step", "(job.z >> 16u) + k", "k"),
    ("row_step", "sqrt(v * bias2)", "sqrt(v)"),
    ("row_step", "states[i] != 1u", "states[i] == 0u"),
    ("row_add", "(states[i] & 2u) != 0u", "states[i] == 9u"),
    ("row_add", "+ job.z]", "]"),
    ("row_add", "sums[i * job.y + k] +=", "sums[i * job.y + k] ="),
    ("area_average", "share_of(row, y) * image", "image"),
    ("area_average", "channel < job.y", "channel < 3u"),
    ("area_average", "4u * (job.x + block)", "4u * block"),
    ("area_average", "cell / cells[2]", "cell % cells[2]"),
    ("area_spread", "bitcast<f32>(job.z) * sum", "sum"),
    ("area_spread", "across + 1u]; x", "across]; x"),
    ("area_spread", "y * cells[2] + x", "y * cells[2]"),
    ("area_spread", "4u * (job.x + block)", "4u * block"),
    ("embedding_loss", "select(0.0, 1.0, off < 0.0)", "0.0"),
    ("embedding_loss", "trusted * bitcast<f32>(job.w)", "bitcast<f32>(job.w)"),
    ("embedding_loss", "trust[i % job.z]", "trust[0]"),
    ("embedding_loss", "abs(off)", "off * off"),
    ("sampled", "image[pixels[pixel]", "image[pixels[pixel / 2u]"),
    ("sampled", "channel < job.y", "channel < 4u"),
    ("sampled", "pixels[pixel] * BLOCKS + block", "pixels[pixel] * BLOCKS"),
    ("units", "groups_of[i] == NO_MASK", "groups_of[i] == 0u"),
    ("units", "!finite(squares)", "false"),
    ("units", "squares += v * v", "squares += abs(v)"),
    ("mates", "other != pixel && ", ""),
    ("mates", "lengths[pixel] > 0.0", "true"),
    ("mates", "vec2f(0.0, 1.0), vec2f(1.0, 0.0)", "vec2f(1.0, 0.0), vec2f(0.0, 1.0)"),
    ("mates", "> 0.0;", "> 0.6;"),
    ("pairs", "other != pixel && ", ""),
    ("pairs", "cosine > 0.0", "true"),
    ("pairs", "-likeness * near", "-near"),
    ("pairs", "losses[pixel] += all", "losses[pixel] = all"),
    ("pairs", "results[0] * weight", "weight"),
    ("pairs", "piece.reads + k", "k"),
    ("pull", "2.0 * (grad", "(grad"),
    ("pull", "- along * features[c * job.x + pixel]", ""),
    ("pull", ") / length", ")"),
    ("pull", "pulls[c * job.x + pixel]", "pulls[c * job.x + k]"),
    ("cosines", "sums[first + q] += product", "sums[first + q] = product"),
    ("cosines", "q * job.z + job.w + b", "q * job.z + b"),
    ("cosines", "sums[first + job.y] += squares", "sums[first + job.y] = squares"),
    ("fuse", "!finite(squares) || ", ""),
    ("fuse", "(cosine - top) * bitcast<f32>(job.z)", "(cosine - top)"),
    ("fuse", "sum / weight", "top"),
    ("fuse", "clamp(sums[first + q] * norm, -1.0, 1.0);", "sums[first + q];"),
    ("add_pull", "+= sum", "= sum"),
    ("add_pull", "4u * (job.x + block)", "4u * block"),
];

#[test]
fn a_fault_in_any_kernel_of_training_is_seen() {
    let Some(gpu) = engine("a_fault_in_any_kernel_of_training_is_seen") else { return };
    are_laid_to(&[check_splats], gpu, TRAINING_FAULTS);
}

#[test]
fn a_fault_in_any_kernel_of_a_photos_comparison_is_seen() {
    let Some(gpu) = engine("a_fault_in_any_kernel_of_a_photos_comparison_is_seen") else { return };
    are_laid_to(&[check_comparison], gpu, COMPARISON_FAULTS);
}

#[test]
#[ignore = "takes minutes on software Vulkan: run it after a change of shaders/"]
fn a_fault_in_any_kernel_of_the_appearance_networks_is_seen() {
    let Some(gpu) = engine("a_fault_in_any_kernel_of_the_appearance_networks_is_seen") else { return };
    are_laid_to(&[check_networks, check_comparison], gpu, NETWORK_FAULTS);
}

#[test]
#[ignore = "takes minutes on software Vulkan: run it after a change of shaders/"]
fn a_fault_in_any_kernel_of_the_feature_field_is_seen() {
    let Some(gpu) = engine("a_fault_in_any_kernel_of_the_feature_field_is_seen") else { return };
    are_laid_to(&[check_field], gpu, FIELD_FAULTS);
}
