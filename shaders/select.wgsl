// Numbers of the splats after density control, selected from those of their parents (twins: `Adam::select` and
// `Adam::forget` in objective/src/adam.rs). One thread per number; numbers come in items of a few, one item per splat.
#import common

// x: numbers, y: numbers of an item, z: 1 if items of forgotten splats become 0, w: how many of an item's numbers are
// kept.
@group(0) @binding(0) var<uniform> job: vec4u;
// Per splat, its parent, and 1 if it is forgotten.
@group(0) @binding(1) var<storage, read> parents: array<vec2u>;
@group(0) @binding(2) var<storage, read> before: array<f32>;
@group(0) @binding(3) var<storage, read_write> after: array<f32>;

@compute @workgroup_size(256)
fn select_items(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    if k >= job.x {
        return;
    }
    let parent = parents[k / job.y];
    let lane = k % job.y;
    let known = lane < job.w && !(job.z == 1u && parent.y == 1u);
    after[k] = select(0.0, before[parent.x * job.y + lane], known);
}
