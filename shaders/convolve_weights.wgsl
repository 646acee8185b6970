// Gradients of a layer's weights, of a slice of its columns (twins: `Conv::kernel_gradient` in nn/src/conv.rs and
// `Mlp::backward` in nn/src/mlp.rs); the layer is that of the forward pass. A group takes 32 planes and 128 weights of
// each, the offset last; a thread four of both. `sum_weights` adds slices up.
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

fn grad_at(layer: Layer, plane: u32, column: u32, pixel: vec2u) -> f32 {
    if plane >= layer.output {
        return 0.0;
    }
    return grads[written(layer, plane, column, pixel)];
}

// Input of the weight `k`; the last is the offset.
fn map_at(layer: Layer, k: u32, wide: u32, tap: Tap, pixel: vec2u) -> f32 {
    if k + 1u >= wide {
        return select(0.0, 1.0, k + 1u == wide);
    }
    let position = tapped(layer, tap, pixel);
    if position == NOWHERE {
        return 0.0;
    }
    return maps[position];
}

fn put(layer: Layer, slice: u32, plane: u32, k: u32, wide: u32, sum: f32) {
    if k < wide {
        parts[(slice * layer.output + plane) * wide + k] = sum;
    }
}

fn put_four(layer: Layer, slice: u32, plane: u32, k: u32, wide: u32, sums: vec4f) {
    if slice < job.z && plane < layer.output {
        put(layer, slice, plane, k, wide, sums.x);
        put(layer, slice, plane, k + 1u, wide, sums.y);
        put(layer, slice, plane, k + 2u, wide, sums.z);
        put(layer, slice, plane, k + 3u, wide, sums.w);
    }
}

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
    // The weights whose numbers this thread fetches: twice four.
    let mine = first + (local / DEPTH) * 4u;
    let tap_a = tap_of(layer, mine);
    let tap_b = tap_of(layer, mine + 1u);
    let tap_c = tap_of(layer, mine + 2u);
    let tap_d = tap_of(layer, mine + 3u);
    let more = mine + 64u;
    let tap_e = tap_of(layer, more);
    let tap_f = tap_of(layer, more + 1u);
    let tap_g = tap_of(layer, more + 2u);
    let tap_h = tap_of(layer, more + 3u);
    var sums_a = vec4f(0.0);
    var sums_b = vec4f(0.0);
    var sums_c = vec4f(0.0);
    var sums_d = vec4f(0.0);
    for (var start = slice * job.w; start < end; start += DEPTH) {
        // Neighbours take neighbouring columns.
        let at = start + local % DEPTH;
        let pixel = pixel_of(layer, at);
        var grad = vec4f(0.0);
        var low = vec4f(0.0);
        var high = vec4f(0.0);
        if at < end {
            if local < 128u {
                let row = plane + (local / DEPTH) * 4u;
                grad = vec4f(
                    grad_at(layer, row, at, pixel),
                    grad_at(layer, row + 1u, at, pixel),
                    grad_at(layer, row + 2u, at, pixel),
                    grad_at(layer, row + 3u, at, pixel),
                );
            }
            low = vec4f(
                map_at(layer, mine, wide, tap_a, pixel),
                map_at(layer, mine + 1u, wide, tap_b, pixel),
                map_at(layer, mine + 2u, wide, tap_c, pixel),
                map_at(layer, mine + 3u, wide, tap_d, pixel),
            );
            high = vec4f(
                map_at(layer, more, wide, tap_e, pixel),
                map_at(layer, more + 1u, wide, tap_f, pixel),
                map_at(layer, more + 2u, wide, tap_g, pixel),
                map_at(layer, more + 3u, wide, tap_h, pixel),
            );
        }
        if local < 128u {
            left[(local % DEPTH) * 8u + local / DEPTH] = grad;
        }
        let to = (local % DEPTH) * 32u + local / DEPTH;
        right[to] = low;
        right[to + 16u] = high;
        workgroupBarrier();
        for (var c = 0u; c < DEPTH; c += 1u) {
            let grad = left[c * 8u + local / 32u];
            let seen = right[c * 32u + local % 32u];
            sums_a += grad.x * seen;
            sums_b += grad.y * seen;
            sums_c += grad.z * seen;
            sums_d += grad.w * seen;
        }
        workgroupBarrier();
    }
    let own = plane + (local / 32u) * 4u;
    let k = first + (local % 32u) * 4u;
    put_four(layer, slice, own, k, wide, sums_a);
    put_four(layer, slice, own + 1u, k, wide, sums_b);
    put_four(layer, slice, own + 2u, k, wide, sums_c);
    put_four(layer, slice, own + 3u, k, wide, sums_d);
}
