// The state from which `backward` starts at each bucket: the transmittance, and the gradient times what has been passed,
// per pixel; and the gradient times the total. The same walk as `blend`, with the gradient by the blending weight
// (`weight_grad.wgsl`) as the value.
#import common
#import view
#import footprint

// x: vec4 per splat and per pixel.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(3) var<storage, read> entries: array<vec2u>;
@group(0) @binding(4) var<storage, read> tiles: array<vec4u>;
@group(0) @binding(5) var<storage, read> values: array<vec4f>;
@group(0) @binding(6) var<storage, read> grads: array<vec4f>;
// Transmittance, and the sum so far, `[bucket][pixel of the tile]`.
@group(0) @binding(7) var<storage, read_write> states: array<vec2f>;
// `[tile][pixel of the tile]`.
@group(0) @binding(8) var<storage, read_write> totals: array<f32>;
#import weight_grad

var<workgroup> lit: atomic<u32>;
var<workgroup> print_p: array<vec4f, BUCKET>;
var<workgroup> print_q: array<vec4f, BUCKET>;
var<workgroup> splats: array<u32, BUCKET>;
var<workgroup> value: array<vec4f, BUCKET * REGISTERS>;

@compute @workgroup_size(256)
fn bucket_states(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let tile = group_of(id, groups);
    if tile >= view.frame.z * view.frame.w {
        return;
    }
    let range = tiles[tile];
    let at = pixel_of(tile, local, view.frame.z);
    let inside = at.x < view.frame.x && at.y < view.frame.y;
    let position = at.y * view.frame.x + at.x;
    let pixel = vec2f(at) + 0.5;
    var transmittance = select(0.0, 1.0, inside);
    var passed = 0.0;
    var grad: array<vec4f, REGISTERS>;
    if inside {
        for (var b = 0u; b < BLOCKS; b += 1u) {
            grad[b] = grads[position * BLOCKS + b];
        }
    }

    var bucket = range.z;
    var next = range.x;
    for (; next < range.y; next += BUCKET) {
        if local == 0u {
            atomicStore(&lit, 0u);
        }
        workgroupBarrier();
        if transmittance >= T_MIN {
            atomicStore(&lit, 1u);
        }
        let count = min(BUCKET, range.y - next);
        let k = local % BUCKET;
        if k < count {
            let splat = entries[next + k].x;
            let lane = local / BUCKET;
            if lane == 0u {
                splats[k] = splat;
                print_p[k] = footprints[2u * splat];
                print_q[k] = footprints[2u * splat + 1u];
            }
            if lane < BLOCKS {
                value[k * REGISTERS + lane] = values[splat * BLOCKS + lane];
            }
        }
        workgroupBarrier();
        if atomicLoad(&lit) == 0u {
            break;
        }
        states[bucket * PIXELS + local] = vec2f(transmittance, passed);
        bucket += 1u;
        for (var i = 0u; i < count && transmittance >= T_MIN; i += 1u) {
            let hit = touch(footprint(print_p[i], print_q[i]), pixel);
            if hit.raw >= ALPHA_MIN {
                let weight = min(hit.raw, ALPHA_MAX) * transmittance;
                transmittance -= weight;
                var weight_grad = 0.0;
                if BLOCKS == 0u {
                    weight_grad = weight_grad_from_memory(splats[i], position, job.x);
                }
                for (var b = 0u; b < BLOCKS; b += 1u) {
                    weight_grad += dot(value[i * REGISTERS + b], grad[b]);
                }
                passed += weight * weight_grad;
            }
        }
        workgroupBarrier();
    }
    for (; next < range.y; next += BUCKET) {
        states[bucket * PIXELS + local] = vec2f(0.0, passed);
        bucket += 1u;
    }
    totals[tile * PIXELS + local] = passed;
}
