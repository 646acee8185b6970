// Adds the sums of a view to those of the rows that it sees and whose numbers are all finite (twin: `Lifting::add` in
// objective/src/field/lifting.rs). One thread per row.
#import common

// x: rows, y: vec4 of a row's part, z: where the weight lies in the last part.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> results: array<vec4f>;
// Of `row_state`, of all parts.
@group(0) @binding(2) var<storage, read> states: array<u32>;
// The last part.
@group(0) @binding(3) var<storage, read> last: array<f32>;
@group(0) @binding(4) var<storage, read_write> sums: array<vec4f>;

@compute @workgroup_size(256)
fn row_add(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x || (states[i] & 2u) != 0u || !(last[4u * i * job.y + job.z] > 0.0) {
        return;
    }
    for (var k = 0u; k < job.y; k += 1u) {
        sums[i * job.y + k] += results[i * job.y + k];
    }
}
