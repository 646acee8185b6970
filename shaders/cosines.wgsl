// Products of a part of every row's numbers with some queries, added to those of the other parts, and the squares of the row
// itself (twin: `score` in objective/src/field/similarity.rs). A thread per row.
#import common

// x: rows, y: queries, z: vec4 of a query, w: where the part starts in it.
@group(0) @binding(0) var<uniform> job: vec4u;
// BLOCKS vec4 per row.
@group(0) @binding(1) var<storage, read> values: array<vec4f>;
// Unit vectors.
@group(0) @binding(2) var<storage, read> queries: array<vec4f>;
// Of each row one per query, then its squares.
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(256)
fn cosines(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    let first = i * (job.y + 1u);
    for (var q = 0u; q < job.y; q += 1u) {
        var product = 0.0;
        for (var b = 0u; b < BLOCKS; b += 1u) {
            product += dot(values[i * BLOCKS + b], queries[q * job.z + job.w + b]);
        }
        sums[first + q] += product;
    }
    var squares = 0.0;
    for (var b = 0u; b < BLOCKS; b += 1u) {
        squares += dot(values[i * BLOCKS + b], values[i * BLOCKS + b]);
    }
    sums[first + job.y] += squares;
}
