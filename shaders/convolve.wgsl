// A layer's product of weights and what its kernel sees, forward or back to its input (twins: `convolve` in nets/src/conv.rs,
// `Mlp::forward` and `Mlp::backward` in nets/src/mlp.rs: a dense layer is a kernel of one tap over splats instead of pixels).
// A group makes 32 planes of 64 columns; a thread four of these planes at two columns.
#import common
#import layer

// x: layer, y: first splat of the piece.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
@group(0) @binding(2) var<storage, read> weights: array<f32>;
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;
// How many splats are in sight.
@group(0) @binding(4) var<storage, read> in_sight: array<u32>;

const DEPTH: u32 = 16u;
// `[plane][depth]` and `[depth][column]`.
var<workgroup> left: array<f32, 512>;
var<workgroup> right: array<f32, 1024>;

@compute @workgroup_size(256)
fn convolve(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let group = group_of(id, groups);
    let room = layer.out_width * layer.out_height;
    let across = (room + 63u) / 64u;
    let columns = columns_of(layer, job.y, in_sight[0]);
    let column = (group % across) * 64u;
    let plane = (group / across) * 32u;
    let taps = layer.kernel * layer.kernel;
    let depth = layer.input * taps;
    let mine = (local / 32u) * 4u;
    var sums: array<vec2f, 4>;
    for (var start = 0u; start < depth; start += DEPTH) {
        for (var n = local; n < 512u; n += 256u) {
            let k = start + n % DEPTH;
            let o = plane + n / DEPTH;
            var weight = 0.0;
            if k < depth && o < layer.output {
                let tap = select(k % taps, taps - 1u - k % taps, is_set(layer, TURNED));
                weight = weights[layer.weights + o * layer.by_output + (k / taps) * layer.by_input + tap];
            }
            left[n] = weight;
        }
        for (var n = local; n < 1024u; n += 256u) {
            let k = start + n / 64u;
            let at = column + n % 64u;
            var seen = 0.0;
            if k < depth && at < columns {
                let place = tapped(layer, k / taps, k % taps, at);
                if place != NONE {
                    seen = maps[place];
                }
            }
            right[n] = seen;
        }
        workgroupBarrier();
        for (var k = 0u; k < DEPTH; k += 1u) {
            let seen = vec2f(right[k * 64u + local % 32u], right[k * 64u + local % 32u + 32u]);
            for (var o = 0u; o < 4u; o += 1u) {
                sums[o] += left[(mine + o) * DEPTH + k] * seen;
            }
        }
        workgroupBarrier();
    }
    for (var o = 0u; o < 4u; o += 1u) {
        for (var half = 0u; half < 2u; half += 1u) {
            let at = column + local % 32u + 32u * half;
            let to = plane + mine + o;
            if at >= columns || to >= layer.output {
                continue;
            }
            var made = sums[o][half];
            var place = layer.writes + to * room + at;
            var offset = to;
            if is_set(layer, WRITE_QUARTERS) {
                place = layer.writes + quarter(to, at, layer.out_width, layer.out_height);
                offset = to / 4u;
            }
            if layer.offsets != NONE {
                made += weights[layer.offsets + offset];
            }
            if is_set(layer, ADD) {
                made += maps[place];
            }
            maps[place] = select(made, max(made, 0.0), is_set(layer, RELU));
        }
    }
}
