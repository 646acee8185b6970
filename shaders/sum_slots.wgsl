// Sum of each splat's slots, in the order of tiles (twin: `sum_slots` in raster/src/cpu/kernels.rs). One thread per vec4.
#import common

// x: splats, y: vec4 per slot.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> slots_of: array<vec2u>;
@group(0) @binding(2) var<storage, read> slots: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> sums: array<vec4f>;

@compute @workgroup_size(256)
fn sum_slots(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x * job.y {
        return;
    }
    let own = slots_of[i / job.y];
    var sum = vec4f(0.0);
    for (var k = 0u; k < own.y; k += 1u) {
        sum += slots[(own.x + k) * job.y + i % job.y];
    }
    sums[i] = sum;
}
