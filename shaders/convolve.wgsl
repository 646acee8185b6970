// A layer's product of weights and what its kernel sees, forward or back to its input (twins: `convolve` in nets/src/conv.rs,
// `Mlp::forward` and `Mlp::backward` in nets/src/mlp.rs: a dense layer is a kernel of one tap over splats instead of pixels).
// A group makes 32 planes of 128 columns; a thread four of these planes at four columns.
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
// `[depth][four planes]` and `[depth][four columns]`.
var<workgroup> left: array<vec4f, 128>;
var<workgroup> right: array<vec4f, 512>;

@compute @workgroup_size(256)
fn convolve(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let group = group_of(id, groups);
    let room = layer.out_width * layer.out_height;
    let across = (room + 127u) / 128u;
    let columns = columns_of(layer, job.y, in_sight[0]);
    let column = (group % across) * 128u;
    let plane = (group / across) * 32u;
    let taps = layer.kernel * layer.kernel;
    let depth = layer.input * taps;
    var sums: array<vec4f, 4>;
    for (var start = 0u; start < depth; start += DEPTH) {
        if local < 128u {
            let k = start + local / 8u;
            var four = vec4f(0.0);
            if k < depth {
                let tap = select(k % taps, taps - 1u - k % taps, is_set(layer, TURNED));
                let first = layer.weights + (k / taps) * layer.by_input + tap;
                for (var o = 0u; o < 4u; o += 1u) {
                    let to = plane + (local % 8u) * 4u + o;
                    if to < layer.output {
                        four[o] = weights[first + to * layer.by_output];
                    }
                }
            }
            left[local] = four;
        }
        for (var n = local; n < 512u; n += 256u) {
            let k = start + n / 32u;
            var four = vec4f(0.0);
            if k < depth {
                for (var c = 0u; c < 4u; c += 1u) {
                    let at = column + (n % 32u) * 4u + c;
                    if at < columns {
                        let place = tapped(layer, k / taps, k % taps, at);
                        if place != NOWHERE {
                            four[c] = maps[place];
                        }
                    }
                }
            }
            right[n] = four;
        }
        workgroupBarrier();
        for (var k = 0u; k < DEPTH; k += 1u) {
            let weight = left[k * 8u + local / 32u];
            let seen = right[k * 32u + local % 32u];
            for (var o = 0u; o < 4u; o += 1u) {
                sums[o] += weight[o] * seen;
            }
        }
        workgroupBarrier();
    }
    for (var o = 0u; o < 4u; o += 1u) {
        let to = plane + (local / 32u) * 4u + o;
        for (var c = 0u; c < 4u; c += 1u) {
            let at = column + (local % 32u) * 4u + c;
            if at >= columns || to >= layer.output {
                continue;
            }
            var made = sums[o][c];
            var place = layer.writes + to * room + at;
            var offset = to;
            if is_set(layer, WRITE_QUARTERS) {
                place = layer.writes + quarter(to, at, layer.out_width, layer.out_height);
                offset = to / 4u;
            }
            if layer.offsets != NOWHERE {
                made += weights[layer.offsets + offset];
            }
            if is_set(layer, ADD) {
                made += maps[place];
            }
            maps[place] = select(made, max(made, 0.0), is_set(layer, RELU));
        }
    }
}
