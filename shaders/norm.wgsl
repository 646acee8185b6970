// Normalises planes in groups (twin: `GroupNorm::forward` in nn/src/norm.rs). A workgroup per group of planes.
#import common
#import layer
#import sum

alias Summed = f32;

// x: layer.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;

@compute @workgroup_size(256)
fn norm(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let group = group_of(id, groups);
    let n = layer.in_width * layer.in_height;
    let many = layer.kernel * n;
    let start = group * many;
    let first = layer.reads + start;
    var mine = 0.0;
    for (var k = local; k < many; k += 256u) {
        mine += maps[first + k];
    }
    let centre = sum_of_group(local, mine) / f32(many);
    mine = 0.0;
    for (var k = local; k < many; k += 256u) {
        let off = maps[first + k] - centre;
        mine += off * off;
    }
    let scale = 1.0 / sqrt(sum_of_group(local, mine) / f32(many) + EPSILON);
    for (var k = local; k < many; k += 256u) {
        let normal = (maps[first + k] - centre) * scale;
        let channel = group * layer.kernel + k / n;
        let made = normal * weights[layer.weights + channel] + weights[layer.offsets + channel];
        maps[layer.other + start + k] = normal;
        maps[layer.writes + start + k] = select(made, max(made, 0.0), is_set(layer, RELU));
    }
    if local == 0u {
        maps[layer.other + layer.input * n + group] = scale;
    }
}
