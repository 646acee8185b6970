// Deals the splats to tiles, nearest first: pairs of a splat and a tile (twin: `Bins::fill` in cpu/bin.rs). A splat's
// pairs lie one behind the other: they are its slots.
#import common
#import view
#import footprint
#import cover

// x: splats, y: tiles.
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

@compute @workgroup_size(256)
fn emit(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    if k >= job.x {
        return;
    }
    let splat = sorted[k];
    var slot = starts[k];
    let end = starts[k + 1u];
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
    // A compiler may round the same formula otherwise here than in `project`. What was promised and not found is put
    // behind all tiles, where nobody reads it.
    for (; slot < end; slot += 1u) {
        tiles[slot] = job.y;
        pairs[slot] = slot;
        owners[slot] = splat;
    }
}
