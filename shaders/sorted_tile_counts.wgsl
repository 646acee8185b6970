// Counts of tiles in the order of depths, and a 0 after them, whose running sum is the number of pairs.
#import common

// x: splats.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> sorted: array<u32>;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> starts: array<u32>;

@compute @workgroup_size(256)
fn sorted_tile_counts(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    if k < job.x {
        starts[k] = counts[sorted[k]];
    } else if k == job.x {
        starts[k] = 0u;
    }
}
