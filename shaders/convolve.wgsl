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
    let across = (layer.out_width * layer.out_height + 127u) / 128u;
    let columns = columns_of(layer, job.y, in_sight[0]);
    let column = (group % across) * 128u;
    let plane = (group / across) * 32u;
    let depth = layer.input * layer.kernel * layer.kernel;
    // The columns whose numbers this thread fetches.
    let mine = column + (local % 32u) * 4u;
    var pixels: array<vec2u, 4>;
    for (var c = 0u; c < 4u; c += 1u) {
        pixels[c] = pixel_of(layer, mine + c);
    }
    var sums: array<vec4f, 4>;
    for (var start = 0u; start < depth; start += DEPTH) {
        if local < 128u {
            let k = start + local / 8u;
            var four = vec4f(0.0);
            if k < depth {
                let taps = layer.kernel * layer.kernel;
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
                let tap = tap_of(layer, k);
                for (var c = 0u; c < 4u; c += 1u) {
                    if mine + c < columns {
                        let place = tapped(layer, tap, pixels[c]);
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
            if mine + c >= columns || to >= layer.output {
                continue;
            }
            var made = sums[o][c];
            let place = written(layer, to, mine + c, pixels[c]);
            if layer.offsets != NOWHERE {
                // The quarters of a plane have one.
                made += weights[layer.offsets + select(to, to / 4u, is_set(layer, WRITE_QUARTERS))];
            }
            if is_set(layer, ADD) {
                made += maps[place];
            }
            maps[place] = select(made, max(made, 0.0), is_set(layer, RELU));
        }
    }
}
