// Number of buckets that each tile's entries fill.
#import common

// x: tiles.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> tiles: array<vec4u>;
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;

@compute @workgroup_size(256)
fn bucket_count(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let tile = group_of(id, groups) * 256u + local;
    if tile < job.x {
        counts[tile] = (tiles[tile].y - tiles[tile].x + BUCKET - 1u) / BUCKET;
    }
}
