// Compacts the splats in sight, by running sums of `in_sight` (twin: `in_sight` in
// objective/src/appearance/gsw/points.rs). One thread per splat.
#import common

// x: splats.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> positions: array<u32>;
@group(0) @binding(2) var<storage, read_write> splats: array<u32>;
// Their number.
@group(0) @binding(3) var<storage, read_write> count: array<u32>;

@compute @workgroup_size(256)
fn compact_in_sight(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i < job.x && positions[i + 1u] > positions[i] {
        splats[positions[i]] = i;
    }
    if i == 0u {
        count[0] = positions[job.x];
    }
}
