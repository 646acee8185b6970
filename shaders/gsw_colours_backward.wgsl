// The gradients of the colours of a piece's splats, plane by plane: the backward pass of the small networks starts from
// them (twin: `piece_backward` in objective/src/appearance/gsw/points.rs). One thread per splat.
#import common

// x: splats of a piece, y: first of the piece, z: where the networks' colours start.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> splats: array<u32>;
@group(0) @binding(2) var<storage, read> count: array<u32>;
@group(0) @binding(3) var<storage, read> grads: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> point_grads: array<f32>;

@compute @workgroup_size(256)
fn gsw_colours_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    if k >= job.x || job.y + k >= count[0] {
        return;
    }
    let grad = grads[splats[job.y + k]];
    for (var c = 0u; c < 3u; c += 1u) {
        point_grads[job.z + c * job.x + k] = grad[c];
    }
}
