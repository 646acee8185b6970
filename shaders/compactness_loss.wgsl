// From the cosines of pairs of sampled pixels to the compactness loss and its gradients (twin: `compactness` in
// objective/src/field/compact.rs). A workgroup per pixel, over the columns of a piece.
#import common
#import layer
#import sum
#import masks

alias Summed = f32;

// x: pixels, y: words of a set, z: layer that computed the piece's cosines; the next is its backward pass.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
@group(0) @binding(2) var<storage, read> groups_of: array<u32>;
@group(0) @binding(3) var<storage, read> sets: array<u32>;
// The loss's weight, pairs that share a mask, pairs that share none.
@group(0) @binding(4) var<storage, read> results: array<f32>;
@group(0) @binding(5) var<storage, read> maps: array<f32>;
@group(0) @binding(6) var<storage, read_write> grads: array<f32>;
// Loss of each pixel.
@group(0) @binding(7) var<storage, read_write> losses: array<f32>;

@compute @workgroup_size(256)
fn compactness_loss(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let pixel = group_of(id, groups);
    let piece = layers[job.z];
    let back = layers[job.z + 1u].reads;
    let near = 1.0 / max(results[1], 1.0);
    let far = 1.0 / max(results[2], 1.0);
    var loss = 0.0;
    if pixel < job.x {
        for (var k = local; k < piece.out_width; k += 256u) {
            let cosine = maps[piece.writes + pixel * piece.out_width + k];
            let other = piece.reads + k;
            var weight = 0.0;
            // Those that take no part have a cosine of 0.
            if other != pixel && cosine > 0.0 {
                let likeness = similarity(groups_of[pixel], groups_of[other], job.y);
                weight = select(far, -likeness * near, likeness > 0.0);
                loss += weight * cosine;
            }
            grads[back + pixel * piece.out_width + k] = results[0] * weight;
        }
    }
    let all = sum_of_group(local, loss);
    if local == 0u && pixel < job.x {
        losses[pixel] += all;
    }
}
