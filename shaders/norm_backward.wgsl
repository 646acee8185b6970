// The backward pass of `norm` (twin: `GroupNorm::backward` in nn/src/norm.rs). A workgroup per group of planes.
#import common
#import layer
#import sum

alias Summed = vec2f;

// x: layer, that of the forward pass.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read> maps: array<f32>;
// Laid out as the maps.
@group(0) @binding(4) var<storage, read_write> grads: array<f32>;
@group(0) @binding(5) var<storage, read_write> weight_grads: array<f32>;

@compute @workgroup_size(256)
fn norm_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let group = group_of(id, groups);
    let n = layer.in_width * layer.in_height;
    let many = layer.kernel * n;
    let start = group * many;
    var all = vec2f(0.0);
    for (var c = 0u; c < layer.kernel; c += 1u) {
        let channel = group * layer.kernel + c;
        var mine = vec2f(0.0);
        for (var k = local; k < n; k += 256u) {
            let at = start + c * n + k;
            mine += grads[layer.writes + at] * vec2f(1.0, maps[layer.other + at]);
        }
        let sums = sum_of_group(local, mine);
        all += weights[layer.weights + channel] * sums;
        if local == 0u {
            weight_grads[layer.weights + channel] += sums.y;
            weight_grads[layer.offsets + channel] += sums.x;
        }
    }
    let means = all / f32(many);
    let scale = maps[layer.other + layer.input * n + group];
    for (var k = local; k < many; k += 256u) {
        let at = start + k;
        let factor = weights[layer.weights + group * layer.kernel + k / n];
        grads[layer.reads + at] =
            scale * (grads[layer.writes + at] * factor - means.x - maps[layer.other + at] * means.y);
    }
}
