// Gradients of a layer's weights, of a slice of its columns (twins: `Conv::kernel_gradient` in nets/src/conv.rs and
// `Mlp::backward` in nets/src/mlp.rs); the layer is that of the way forward. A group takes 32 planes and 32 of what each has
// weights for, the offset last; a thread four of these planes. `sum_weights` adds slices up.
#import common
#import layer

// Columns of a slice.
const SLICE: u32 = 1024u;

// x: layer, y: first splat of the piece, z: slices.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
@group(0) @binding(2) var<storage, read> maps: array<f32>;
// Laid out as the maps.
@group(0) @binding(3) var<storage, read> grads: array<f32>;
// `[slice][plane][weight of it]`.
@group(0) @binding(4) var<storage, read_write> parts: array<f32>;
@group(0) @binding(5) var<storage, read> in_sight: array<u32>;

const DEPTH: u32 = 32u;
// `[plane][column]` and `[weight][column]`, one more so that columns lie in different banks.
var<workgroup> left: array<f32, 1056>;
var<workgroup> right: array<f32, 1056>;

@compute @workgroup_size(256)
fn convolve_weights(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let group = group_of(id, groups);
    let room = layer.out_width * layer.out_height;
    let columns = columns_of(layer, job.y, in_sight[0]);
    let taps = layer.kernel * layer.kernel;
    let wide = layer.input * taps + 1u;
    let across = (wide + 31u) / 32u;
    let down = (layer.output + 31u) / 32u;
    let first = (group % across) * 32u;
    let plane = ((group / across) % down) * 32u;
    let slice = group / (across * down);
    let end = min(columns, (slice + 1u) * SLICE);
    var sums: array<f32, 4>;
    for (var start = slice * SLICE; start < end; start += DEPTH) {
        for (var n = local; n < 1024u; n += 256u) {
            let at = start + n % DEPTH;
            let o = plane + n / DEPTH;
            let k = first + n / DEPTH;
            var grad = 0.0;
            if at < end && o < layer.output {
                var place = layer.writes + o * room + at;
                if is_set(layer, WRITE_QUARTERS) {
                    place = layer.writes + quarter(o, at, layer.out_width, layer.out_height);
                }
                grad = grads[place];
            }
            left[n + n / DEPTH] = grad;
            var seen = 0.0;
            if at < end && k < wide {
                seen = 1.0;
                if k + 1u < wide {
                    let place = tapped(layer, k / taps, k % taps, at);
                    seen = 0.0;
                    if place != NONE {
                        seen = maps[place];
                    }
                }
            }
            right[n + n / DEPTH] = seen;
        }
        workgroupBarrier();
        for (var c = 0u; c < DEPTH; c += 1u) {
            let seen = right[(local % 32u) * 33u + c];
            for (var o = 0u; o < 4u; o += 1u) {
                sums[o] += left[((local / 32u) * 4u + o) * 33u + c] * seen;
            }
        }
        workgroupBarrier();
    }
    let k = first + local % 32u;
    for (var o = 0u; o < 4u; o += 1u) {
        let row = plane + (local / 32u) * 4u + o;
        if slice < job.z && row < layer.output && k < wide {
            parts[(slice * layer.output + row) * wide + k] = sums[o];
        }
    }
}
