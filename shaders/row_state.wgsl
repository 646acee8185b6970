// Flags per row, from a part of its gradients: whether it has a gradient, and whether one is not finite (twin:
// `RowAdam::step` in objective/src/field/rows.rs). One thread per row.
#import common

// x: rows, y: vec4 of a row's part.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> grads: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> states: array<u32>;

@compute @workgroup_size(256)
fn row_state(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    var state = 0u;
    for (var k = 0u; k < job.y; k += 1u) {
        let grad = grads[i * job.y + k];
        if !finite4(grad) {
            state |= 2u;
        } else if any(grad != vec4f(0.0)) {
            state |= 1u;
        }
    }
    states[i] |= state;
}
