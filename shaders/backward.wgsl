// Sums over a splat's pixels that carry all geometric gradients, per splat and tile (twin: `Backward` in
// raster/src/cpu/kernels.rs, `Moments` in raster/src/cpu/project.rs). A workgroup is a bucket, a thread an entry, and
// the pixels stream through the threads as in `gather`. Front to back: the contribution of farther splats is the total
// minus what has been passed. The gradients of the values are `gather` of the image's gradients; alpha is a channel of
// value 1.
#import common
#import view
#import footprint

// x: vec4 per splat and per pixel, y: upper bound on the buckets.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(3) var<storage, read> entries: array<vec2u>;
@group(0) @binding(4) var<storage, read> buckets: array<vec4u>;
@group(0) @binding(5) var<storage, read> values: array<vec4f>;
@group(0) @binding(6) var<storage, read> grads: array<vec4f>;
@group(0) @binding(7) var<storage, read> states: array<vec2f>;
@group(0) @binding(8) var<storage, read> totals: array<f32>;
// Two vec4 per slot: g, g_u, g_uu, g_y; g_uy, g_yy, abs_x, abs_y.
@group(0) @binding(9) var<storage, read_write> moments: array<vec4f>;
#import weight_grad

var<workgroup> transmittance: array<f32, PIXELS>;
var<workgroup> remaining: array<f32, PIXELS>;
var<workgroup> grad: array<vec4f, PIXELS * REGISTERS>;

@compute @workgroup_size(64)
fn backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    if group >= job.y {
        return;
    }
    let bucket = buckets[group];
    if bucket.z == 0u {
        return;
    }
    for (var p = local; p < PIXELS; p += BUCKET) {
        let state = states[group * PIXELS + p];
        transmittance[p] = state.x;
        remaining[p] = totals[bucket.x * PIXELS + p] - state.y;
        let at = pixel_of(bucket.x, p, view.frame.z);
        if at.x < view.frame.x && at.y < view.frame.y {
            for (var b = 0u; b < BLOCKS; b += 1u) {
                grad[p * REGISTERS + b] = grads[(at.y * view.frame.x + at.x) * BLOCKS + b];
            }
        }
    }
    var f: Footprint;
    var entry = vec2u(0u, 0u);
    var value: array<vec4f, REGISTERS>;
    if local < bucket.z {
        entry = entries[bucket.y + local];
        f = footprint(footprints[2u * entry.x], footprints[2u * entry.x + 1u]);
        for (var b = 0u; b < BLOCKS; b += 1u) {
            value[b] = values[entry.x * BLOCKS + b];
        }
    }
    var m0 = vec4f(0.0);
    var m1 = vec4f(0.0);
    workgroupBarrier();
    for (var step = 0u; step < PIXELS + bucket.z - 1u; step += 1u) {
        if local < bucket.z && step >= local && step - local < PIXELS {
            let p = step - local;
            let t = transmittance[p];
            if t >= T_MIN {
                let at = pixel_of(bucket.x, p, view.frame.z);
                let hit = touch(f, vec2f(at) + 0.5);
                if hit.raw >= ALPHA_MIN {
                    let alpha = min(hit.raw, ALPHA_MAX);
                    let weight = alpha * t;
                    transmittance[p] = t - weight;
                    var weight_grad = 0.0;
                    if BLOCKS == 0u {
                        weight_grad = weight_grad_from_memory(entry.x, at.y * view.frame.x + at.x, job.x);
                    }
                    for (var b = 0u; b < BLOCKS; b += 1u) {
                        weight_grad += dot(value[b], grad[p * REGISTERS + b]);
                    }
                    let passed = weight * weight_grad;
                    let rest = remaining[p] - passed;
                    remaining[p] = rest;
                    // Held at ALPHA_MAX, alpha follows no parameter.
                    if hit.raw < ALPHA_MAX {
                        // dL/d ln alpha = w d - alpha / (1 - alpha) remaining.
                        let g = passed - alpha / (1.0 - alpha) * rest;
                        let gu = g * hit.u;
                        let gy = g * hit.dy;
                        m0 += vec4f(g, gu, gu * hit.u, gy);
                        // The gradient of the centre, up to a factor.
                        let x = gu * f.a;
                        let y = gy * f.e - x * f.slope;
                        m1 += vec4f(gu * hit.dy, gy * hit.dy, abs(x), abs(y));
                    }
                }
            }
        }
        workgroupBarrier();
    }
    if local < bucket.z {
        // 2 ln 2 takes the half and the logarithm's base out of a and e.
        let base = 1.3862944;
        moments[2u * entry.y] = m0;
        moments[2u * entry.y + 1u] = vec4f(m1.xy, base * m1.z, base * m1.w);
    }
}
