// The buckets of each tile: runs of at most 64 entries, each the work of one workgroup of `gather` and `backward`.
#import common

// x: tiles.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read_write> tiles: array<vec4u>;
// Running sums of `bucket_count`.
@group(0) @binding(2) var<storage, read> starts: array<u32>;
// Tile, first entry, entries, unused; 0 before.
@group(0) @binding(3) var<storage, read_write> buckets: array<vec4u>;

@compute @workgroup_size(256)
fn buckets_of(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let tile = group_of(id, groups) * 256u + local;
    if tile >= job.x {
        return;
    }
    let first = starts[tile];
    var range = tiles[tile];
    range.z = first;
    tiles[tile] = range;
    var bucket = first;
    for (var entry = range.x; entry < range.y; entry += BUCKET) {
        buckets[bucket] = vec4u(tile, entry, min(BUCKET, range.y - entry), 0u);
        bucket += 1u;
    }
}
