// Where each tile's pairs start and end, once they are sorted by tile.
#import common

// x: pairs, y: tiles.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> sorted_tiles: array<u32>;
@group(0) @binding(2) var<storage, read> sorted_pairs: array<u32>;
@group(0) @binding(3) var<storage, read> owners: array<u32>;
// Splat and slot, tile by tile, nearest first.
@group(0) @binding(4) var<storage, read_write> entries: array<vec2u>;
// Four numbers per tile: first entry, the one after the last, first bucket, unused. 0 before.
@group(0) @binding(5) var<storage, read_write> tiles: array<u32>;

@compute @workgroup_size(256)
fn ranges(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let j = group_of(id, groups) * 256u + local;
    if j >= job.x {
        return;
    }
    let slot = sorted_pairs[j];
    entries[j] = vec2u(owners[slot], slot);
    let tile = sorted_tiles[j];
    if tile >= job.y {
        return;
    }
    if j == 0u || sorted_tiles[max(j, 1u) - 1u] != tile {
        tiles[4u * tile] = j;
    }
    if j + 1u == job.x || sorted_tiles[min(j + 1u, job.x - 1u)] != tile {
        tiles[4u * tile + 1u] = j + 1u;
    }
}
