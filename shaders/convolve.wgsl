// A layer's product of weights and unfolded input, forward or backward to its input (twins: `convolve` in
// nn/src/conv.rs, `Mlp::forward` and `Mlp::backward` in nn/src/mlp.rs: a dense layer is a kernel of one tap over splats
// instead of pixels). A group computes 32 planes of 128 columns; a thread four of these planes at four columns. The
// values of a thread are named one by one: an array that a loop indexes is kept in memory by drivers that do not unroll
// the loop.
#import common
#import layer

// x: layer, y: first splat of the piece.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;
// Number of splats in sight.
@group(0) @binding(4) var<storage, read> in_sight: array<u32>;

const DEPTH: u32 = 16u;
// `[depth][four planes]` and `[depth][four columns]`.
var<workgroup> left: array<vec4f, 128>;
var<workgroup> right: array<vec4f, 512>;

// Four neighbouring columns: where they are, and how many of them there are.
struct Columns {
    first: u32,
    many: u32,
    a: vec2u,
    b: vec2u,
    c: vec2u,
    d: vec2u,
}

fn weight_at(layer: Layer, first: u32, plane: u32) -> f32 {
    if plane >= layer.output {
        return 0.0;
    }
    return weights[first + plane * layer.by_output];
}

// The weights of four planes for the tap `k`.
fn weights_of(layer: Layer, k: u32, plane: u32) -> vec4f {
    let taps = layer.kernel * layer.kernel;
    let tap = select(k % taps, taps - 1u - k % taps, is_set(layer, TURNED));
    let first = layer.weights + (k / taps) * layer.by_input + tap;
    return vec4f(
        weight_at(layer, first, plane),
        weight_at(layer, first, plane + 1u),
        weight_at(layer, first, plane + 2u),
        weight_at(layer, first, plane + 3u),
    );
}

fn map_at(layer: Layer, tap: Tap, pixel: vec2u, is_there: bool) -> f32 {
    if !is_there {
        return 0.0;
    }
    let position = tapped(layer, tap, pixel);
    if position == NOWHERE {
        return 0.0;
    }
    return maps[position];
}

// Inputs of the tap `k` at four columns.
fn seen_by(layer: Layer, k: u32, at: Columns) -> vec4f {
    let tap = tap_of(layer, k);
    return vec4f(
        map_at(layer, tap, at.a, at.many > 0u),
        map_at(layer, tap, at.b, at.many > 1u),
        map_at(layer, tap, at.c, at.many > 2u),
        map_at(layer, tap, at.d, at.many > 3u),
    );
}

fn put(layer: Layer, plane: u32, column: u32, pixel: vec2u, sum: f32, is_there: bool) {
    if !is_there {
        return;
    }
    var made = sum;
    let position = written(layer, plane, column, pixel);
    if layer.offsets != NOWHERE {
        // The quarters of a plane share an offset.
        made += weights[layer.offsets + select(plane, plane / 4u, is_set(layer, WRITE_QUARTERS))];
    }
    if is_set(layer, ADD) {
        made += maps[position];
    }
    maps[position] = select(made, max(made, 0.0), is_set(layer, RELU));
}

fn put_four(layer: Layer, plane: u32, at: Columns, sums: vec4f) {
    if plane < layer.output {
        put(layer, plane, at.first, at.a, sums.x, at.many > 0u);
        put(layer, plane, at.first + 1u, at.b, sums.y, at.many > 1u);
        put(layer, plane, at.first + 2u, at.c, sums.z, at.many > 2u);
        put(layer, plane, at.first + 3u, at.d, sums.w, at.many > 3u);
    }
}

@compute @workgroup_size(256)
fn convolve(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let group = group_of(id, groups);
    let across = (layer.out_width * layer.out_height + 127u) / 128u;
    let columns = columns_of(layer, job.y, in_sight[0]);
    let plane = (group / across) * 32u;
    let depth = layer.input * layer.kernel * layer.kernel;
    let first = (group % across) * 128u + (local % 32u) * 4u;
    let a = pixel_of(layer, first);
    let b = after(layer, a);
    let c = after(layer, b);
    let at = Columns(first, columns - min(columns, first), a, b, c, after(layer, c));
    var sums_a = vec4f(0.0);
    var sums_b = vec4f(0.0);
    var sums_c = vec4f(0.0);
    var sums_d = vec4f(0.0);
    for (var start = 0u; start < depth; start += DEPTH) {
        if local < 128u {
            let k = start + local / 8u;
            var four = vec4f(0.0);
            if k < depth {
                four = weights_of(layer, k, plane + (local % 8u) * 4u);
            }
            left[local] = four;
        }
        for (var n = local; n < 512u; n += 256u) {
            let k = start + n / 32u;
            var four = vec4f(0.0);
            if k < depth {
                four = seen_by(layer, k, at);
            }
            right[n] = four;
        }
        workgroupBarrier();
        for (var k = 0u; k < DEPTH; k += 1u) {
            let weight = left[k * 8u + local / 32u];
            let seen = right[k * 32u + local % 32u];
            sums_a += weight.x * seen;
            sums_b += weight.y * seen;
            sums_c += weight.z * seen;
            sums_d += weight.w * seen;
        }
        workgroupBarrier();
    }
    let own = plane + (local / 32u) * 4u;
    put_four(layer, own, at, sums_a);
    put_four(layer, own + 1u, at, sums_b);
    put_four(layer, own + 2u, at, sums_c);
    put_four(layer, own + 3u, at, sums_d);
}
