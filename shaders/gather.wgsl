// The transpose of `blend`: the sum of alpha T image over the pixels, per splat and tile (twin: `Gather` in
// raster/src/cpu/kernels.rs). A workgroup is a bucket, a thread an entry. The pixels of the tile stream through the
// threads: thread k processes pixel p at step p + k, and passes the remaining transmittance to thread k + 1. So every
// thread adds up its own splat, in the order of pixels, and no two write the same number.
#import common
#import view
#import footprint

// x: upper bound on the buckets.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(3) var<storage, read> entries: array<vec2u>;
@group(0) @binding(4) var<storage, read> buckets: array<vec4u>;
@group(0) @binding(5) var<storage, read> image: array<vec4f>;
@group(0) @binding(6) var<storage, read> transmittances: array<f32>;
// BLOCKS vec4 per slot.
@group(0) @binding(7) var<storage, read_write> slots: array<vec4f>;

var<workgroup> transmittance: array<f32, PIXELS>;
var<workgroup> target_at: array<vec4f, PIXELS * BLOCKS>;

@compute @workgroup_size(64)
fn gather(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    if group >= job.x {
        return;
    }
    let bucket = buckets[group];
    if bucket.z == 0u {
        return;
    }
    for (var p = local; p < PIXELS; p += BUCKET) {
        transmittance[p] = transmittances[group * PIXELS + p];
        let at = pixel_of(bucket.x, p, view.frame.z);
        if at.x < view.frame.x && at.y < view.frame.y {
            for (var b = 0u; b < BLOCKS; b += 1u) {
                target_at[p * BLOCKS + b] = image[(at.y * view.frame.x + at.x) * BLOCKS + b];
            }
        }
    }
    var f: Footprint;
    var slot = 0u;
    if local < bucket.z {
        let entry = entries[bucket.y + local];
        f = footprint(footprints[2u * entry.x], footprints[2u * entry.x + 1u]);
        slot = entry.y;
    }
    var sums: array<vec4f, BLOCKS>;
    workgroupBarrier();
    for (var step = 0u; step < PIXELS + bucket.z - 1u; step += 1u) {
        if local < bucket.z && step >= local && step - local < PIXELS {
            let p = step - local;
            let t = transmittance[p];
            if t >= T_MIN {
                let hit = touch(f, vec2f(pixel_of(bucket.x, p, view.frame.z)) + 0.5);
                if hit.raw >= ALPHA_MIN {
                    let weight = min(hit.raw, ALPHA_MAX) * t;
                    transmittance[p] = t - weight;
                    for (var b = 0u; b < BLOCKS; b += 1u) {
                        sums[b] += weight * target_at[p * BLOCKS + b];
                    }
                }
            }
        }
        workgroupBarrier();
    }
    if local < bucket.z {
        for (var b = 0u; b < BLOCKS; b += 1u) {
            slots[slot * BLOCKS + b] = sums[b];
        }
    }
}
