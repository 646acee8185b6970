// Which splats are in sight (twin: `in_sight` in objective/src/appearance/gsw/points.rs): 1 for those that are, and 0
// after the last.
#import common

// x: splats.
@group(0) @binding(0) var<uniform> job: vec4u;
// Depth, radius, centre per splat.
@group(0) @binding(1) var<storage, read> seen: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> positions: array<u32>;

@compute @workgroup_size(256)
fn in_sight(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i < job.x {
        positions[i] = u32(seen[i].y > 0.0);
    } else if i == job.x {
        positions[i] = 0u;
    }
}
