// Deals the splats to tiles, nearest first: pairs of a splat and a tile (twin: `Bins::fill` in raster/src/cpu/bin.rs).
// A splat's pairs are consecutive: they are its slots. The buffers have a capacity, and unused pairs are filled up;
// where the capacity is too small, that is noted and the results of the view are invalid.
#import common
#import view
#import footprint
#import cover

// x: splats, y: tiles, z: capacity for pairs.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> sorted: array<u32>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read> footprints: array<vec4f>;
// Per splat: its first slot, and how many.
@group(0) @binding(5) var<storage, read_write> slots: array<vec2u>;
@group(0) @binding(6) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(7) var<storage, read_write> pairs: array<u32>;
@group(0) @binding(8) var<storage, read_write> owners: array<u32>;
// Number of pairs, and 1 if the capacity suffices.
@group(0) @binding(9) var<storage, read_write> found: array<u32>;

@compute @workgroup_size(256)
fn emit(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    let pairs_found = starts[job.x];
    if k == 0u {
        found[0] = pairs_found;
        found[1] = u32(pairs_found <= job.z);
    }
    if k >= pairs_found && k < job.z {
        // After all tiles.
        tiles[k] = job.y;
        pairs[k] = k;
        owners[k] = 0u;
    }
    if k >= job.x {
        return;
    }
    let splat = sorted[k];
    var slot = min(starts[k], job.z);
    let end = min(starts[k + 1u], job.z);
    slots[splat] = vec2u(slot, end - slot);
    if slot == end {
        return;
    }
    let f = footprint(footprints[2u * splat], footprints[2u * splat + 1u]);
    let tip = tip_of(f);
    let rows = rows_of(f, view.frame.y);
    for (var row = u32(rows.x) / TILE; row <= u32(rows.y) / TILE; row += 1u) {
        let columns = columns_of(f, tip, rows, row, view.frame.x);
        for (var column = columns.x; column < columns.y && slot < end; column += 1u) {
            tiles[slot] = row * view.frame.z + column;
            pairs[slot] = slot;
            owners[slot] = splat;
            slot += 1u;
        }
    }
    // A compiler may round the same formula otherwise here than in `project`. A pair that was counted and not found is
    // put after all tiles, where no kernel reads it.
    for (; slot < end; slot += 1u) {
        tiles[slot] = job.y;
        pairs[slot] = slot;
        owners[slot] = splat;
    }
}
