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
    ("residual_histogram", "has(photo[i], COUNTS)", "has(photo[i], SKY)"),
    ("residual_limits", "DECAY * before[b]", "before[b]"),
    ("residual_limits", "CONTRAST * quantile(of_held, 0.5)", "9.0 * quantile(of_held, 0.5)"),
    ("residual_limits", "limit = max(limit, threshold(false, share));", ""),
    ("residual_limits", "INITIAL_TRANSIENT_SHARE * limit", "limit"),
    ("pixel_weights", "select(0u, 1u, has(pixel, INITIAL_TRANSIENT))", "0u"),
    ("pixel_weights", "2u * votes >", "votes >"),
    ("pixel_weights", "weight * dot(error, error)", "dot(error, error)"),
    ("pixel_weights", "counted[i] = weight * shown[i].w", "counted[i] = shown[i].w"),
    ("ssim", "2.0 * (m.w - product)", "2.0 * m.w"),
    ("ssim", "along[middle - tap * TILE] +", "along[middle] +"),
    ("ssim", "by_squares = -similarity", "by_squares = similarity"),
    ("l1_ssim_backward", "f32(d > 0.0) - f32(d < 0.0)", "f32(d > 0.0)"),
    ("l1_ssim_backward", "2.0 * x * by.y", "x * by.y"),
    ("l1_ssim_backward", "y * by.z", "x * by.z"),
    ("compose_backward", "g.y * loss_inputs.matrix[1].xyz", "g.y * loss_inputs.matrix[2].xyz"),
    ("compose_backward", "-dot(by_scene, back)", "dot(by_scene, back)"),
    ("compose_backward", "rendered.w, LEAST_OPEN", "rendered.w, 0.95"),
    ("compose_backward", "g[c] * scene", "g[0] * scene"),
    ("sky_sums", "seen[p][12] * seen[p][a]", "seen[p][a]"),
    ("sky_sums", "open * open * weights[i]", "open * weights[i]"),
    ("sky_sums", "9u + (local - PRODUCTS) % 3u", "9u"),
    ("colour_sums", "* open * vec4f", "* vec4f"),
    ("sum_groups", "parts[k * job.y + column]", "parts[k * job.y]"),
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
    ("add_maps", "made += maps[layer.other + k];", ""),
    ("add_maps", "made += maps[layer.writes + k];", ""),
    ("relu_backward", "maps[at] > 0.0", "maps[at] > 0.5"),
    ("in_sight", "seen[i].y > 0.0", "seen[i].y >= 0.0"),
    ("compact_in_sight", "splats[positions[i]] = i", "splats[positions[i]] = positions[i]"),
    ("gsw_inputs", "splat_embeddings[at + 1u]) * COORDINATE", "splat_embeddings[at + 1u]) * 0.2"),
    ("gsw_inputs", "far.y * near.x, far.y * far.x", "far.y * far.x, far.y * near.x"),
    ("gsw_inputs", "c = 1.0 - 2.0 * s * s", "c = 1.0 - s * s"),
    ("gsw_inputs", "mean - reader.eye.xyz", "mean"),
    ("gsw_inputs", "kept(reader, i, d)", "kept(reader, k, d)"),
    ("gsw_colours", "points[at + job.x]", "points[at]"),
    ("gsw_colours_backward", "job.z + c * job.x + k", "job.z + k"),
    ("gsw_inputs_backward", "to_vector + to_light", "to_vector"),
    ("gsw_inputs_backward", "upper.y - upper.x", "upper.x - upper.y"),
    ("gsw_inputs_backward", "* spot.slope", ""),
    ("gsw_inputs_backward", "point_grads[here] = g", "point_grads[here] = 0.5 * g"),
    ("gsw_inputs_backward", "reader.frame.w * sign(at)", "-900.0 * reader.frame.w * sign(at)"),
    ("map_sums", "each.x * each.y", "each.x"),
    ("map_sums", "keys[middle] < key", "keys[middle] <= key"),
    ("map_sums", "grads[to] += sums[s]", "grads[to] = sums[s]"),
    ("visibility_gradient", "2.0 * (1.0 - v)", "(1.0 - v)"),
    ("visibility_gradient", "clamp(residuals[k], 0.0, 2.0)", "residuals[k]"),
    ("part_residuals", "smoothed[i] / limits[2]", "smoothed[i] / limits[0]"),
    ("part_residuals", "has(photo[i], COUNTS)", "has(photo[i], SKY)"),
    ("part_residuals", "limits[2], WRONG)", "limits[2], 1.0)"),
    ("residual_limits", "limits[2] = threshold(false, share)", "limits[2] = 2.0 * threshold(false, share)"),
    ("visibility_weights", "/ (SURE - OCCLUDED)", "/ SURE"),
    ("visibility_weights", "high.x, low.y", "low.x, low.y"),
    ("choose_weights", "counts * seen[i]", "seen[i]"),
    ("choose_weights", "own <= MOST * loss_inputs.numbers.z", "own <= 99.0 * loss_inputs.numbers.z"),
    ("choose_weights", "counted[i] = weight * shown[i].w", "counted[i] = shown[i].w"),
    ("choose_weights", "weight * dot(error, error)", "dot(error, error)"),
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
    ("sampled_features", "image[pixels[pixel]", "image[pixels[pixel / 2u]"),
    ("sampled_features", "channel < job.y", "channel < 4u"),
    ("sampled_features", "pixels[pixel] * BLOCKS + block", "pixels[pixel] * BLOCKS"),
    ("unit_features", "groups_of[i] == NO_MASK", "groups_of[i] == 0u"),
    ("unit_features", "!finite(squares)", "false"),
    ("unit_features", "squares += v * v", "squares += abs(v)"),
    ("mask_pair_counts", "other != pixel && ", ""),
    ("mask_pair_counts", "lengths[pixel] > 0.0", "true"),
    ("mask_pair_counts", "vec2f(0.0, 1.0), vec2f(1.0, 0.0)", "vec2f(1.0, 0.0), vec2f(0.0, 1.0)"),
    ("mask_pair_counts", "> 0.0;", "> 0.6;"),
    ("compactness_loss", "other != pixel && ", ""),
    ("compactness_loss", "cosine > 0.0", "true"),
    ("compactness_loss", "-likeness * near", "-near"),
    ("compactness_loss", "losses[pixel] += all", "losses[pixel] = all"),
    ("compactness_loss", "results[0] * weight", "weight"),
    ("compactness_loss", "piece.reads + k", "k"),
    ("unit_features_backward", "2.0 * (grad", "(grad"),
    ("unit_features_backward", "- along * features[c * job.x + pixel]", ""),
    ("unit_features_backward", ") / length", ")"),
    ("unit_features_backward", "feature_grads[c * job.x + pixel]", "feature_grads[c * job.x + k]"),
    ("cosines", "sums[first + q] += product", "sums[first + q] = product"),
    ("cosines", "q * job.z + job.w + b", "q * job.z + b"),
    ("cosines", "sums[first + job.y] += squares", "sums[first + job.y] = squares"),
    ("fuse", "!finite(squares) || ", ""),
    ("fuse", "(cosine - top) * bitcast<f32>(job.z)", "(cosine - top)"),
    ("fuse", "sum / weight", "top"),
    ("fuse", "clamp(sums[first + q] * norm, -1.0, 1.0);", "sums[first + q];"),
    ("sampled_features_backward", "+= sum", "= sum"),
    ("sampled_features_backward", "4u * (job.x + block)", "4u * block"),
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
