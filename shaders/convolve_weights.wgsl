// Gradients of a layer's weights, of a slice of its columns (twins: `Conv::kernel_gradient` in nets/src/conv.rs and
// `Mlp::backward` in nets/src/mlp.rs); the layer is that of the way forward. A group takes 32 planes and 128 of what each has
// weights for, the offset last; a thread four of both. `sum_weights` adds slices up.
#import common
#import layer

// x: layer, y: first splat of the piece, z: slices, w: columns of each.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
@group(0) @binding(2) var<storage, read> maps: array<f32>;
// Laid out as the maps.
@group(0) @binding(3) var<storage, read> grads: array<f32>;
// `[slice][plane][weight of it]`.
@group(0) @binding(4) var<storage, read_write> parts: array<f32>;
@group(0) @binding(5) var<storage, read> in_sight: array<u32>;

const DEPTH: u32 = 16u;
// `[column][four planes]` and `[column][four weights]`.
var<workgroup> left: array<vec4f, 128>;
var<workgroup> right: array<vec4f, 512>;

@compute @workgroup_size(256)
fn convolve_weights(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let group = group_of(id, groups);
    let columns = columns_of(layer, job.y, in_sight[0]);
    let wide = layer.input * layer.kernel * layer.kernel + 1u;
    let across = (wide + 127u) / 128u;
    let down = (layer.output + 31u) / 32u;
    let first = (group % across) * 128u;
    let plane = ((group / across) % down) * 32u;
    let slice = group / (across * down);
    let end = min(columns, (slice + 1u) * job.w);
    // The weights whose numbers this thread fetches.
    let mine = first + (local / DEPTH) * 4u;
    var taps: array<Tap, 8>;
    for (var c = 0u; c < 8u; c += 1u) {
        taps[c] = tap_of(layer, mine + (c / 4u) * 64u + c % 4u);
    }
    var sums: array<vec4f, 4>;
    for (var start = slice * job.w; start < end; start += DEPTH) {
        // Neighbours take neighbouring columns.
        let at = start + local % DEPTH;
        let pixel = pixel_of(layer, at);
        if local < 128u {
            var four = vec4f(0.0);
            for (var o = 0u; o < 4u; o += 1u) {
                let row = plane + (local / DEPTH) * 4u + o;
                if at < end && row < layer.output {
                    four[o] = grads[written(layer, row, at, pixel)];
                }
            }
            left[(local % DEPTH) * 8u + local / DEPTH] = four;
        }
        for (var half = 0u; half < 2u; half += 1u) {
            var four = vec4f(0.0);
            for (var c = 0u; c < 4u; c += 1u) {
                let k = mine + half * 64u + c;
                if at < end && k + 1u < wide {
                    let place = tapped(layer, taps[half * 4u + c], pixel);
                    if place != NOWHERE {
                        four[c] = maps[place];
                    }
                } else if at < end && k + 1u == wide {
                    four[c] = 1.0;
                }
            }
            right[(local % DEPTH) * 32u + half * 16u + local / DEPTH] = four;
        }
        workgroupBarrier();
        for (var c = 0u; c < DEPTH; c += 1u) {
            let grad = left[c * 8u + local / 32u];
            let seen = right[c * 32u + local % 32u];
            for (var o = 0u; o < 4u; o += 1u) {
                sums[o] += grad[o] * seen;
            }
        }
        workgroupBarrier();
    }
    for (var o = 0u; o < 4u; o += 1u) {
        let row = plane + (local / 32u) * 4u + o;
        for (var c = 0u; c < 4u; c += 1u) {
            let k = first + (local % 32u) * 4u + c;
            if slice < job.z && row < layer.output && k < wide {
                parts[(slice * layer.output + row) * wide + k] = sums[o][c];
            }
        }
    }
}
