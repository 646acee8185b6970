// Adds the output of the small networks for a piece of splats to their colours (twin: `tint` in
// objective/src/appearance/gsw/points.rs). One thread per splat.
#import common

// x: splats of a piece, y: first of the piece, z: where the networks' colours start.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> splats: array<u32>;
@group(0) @binding(2) var<storage, read> count: array<u32>;
@group(0) @binding(3) var<storage, read> points: array<f32>;
@group(0) @binding(4) var<storage, read_write> colours: array<vec4f>;

@compute @workgroup_size(256)
fn gsw_colours(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    if k >= job.x || job.y + k >= count[0] {
        return;
    }
    let at = job.z + k;
    let made = vec3f(points[at], points[at + job.x], points[at + 2u * job.x]);
    colours[splats[job.y + k]] += vec4f(made, 0.0);
}
