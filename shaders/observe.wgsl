// Adds statistics of a step per splat, until density control acts (twin: `Stats::observe` in
// trainer/src/density/mod.rs). One thread per splat.
#import common
#import view

// x: splats.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> seen: array<vec4f>;
// Output of `project_backward`.
@group(0) @binding(3) var<storage, read> grads: array<vec4f>;
// Per pixel.
@group(0) @binding(4) var<storage, read> error: array<f32>;
// Screen gradient, error at the centre, steps that saw it, largest radius as a share of the frame's long side.
@group(0) @binding(5) var<storage, read_write> sums: array<vec4f>;
// Of `emit`: a view whose pairs exceed the capacity is skipped.
@group(0) @binding(6) var<storage, read> found: array<u32>;

@compute @workgroup_size(256)
fn observe(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x || found[1] == 0u {
        return;
    }
    let splat = seen[i];
    let radius = splat.y;
    if !(radius > 0.0) {
        return;
    }
    let size = vec2f(view.frame.xy);
    var here = 0.0;
    if all(splat.zw >= vec2f(0.0)) && all(splat.zw < size) {
        here = error[u32(splat.w) * view.frame.x + u32(splat.z)];
    }
    let before = sums[i];
    let share = radius / max(size.x, size.y);
    sums[i] = vec4f(before.x + grads[4u * i + 3u].x, before.y + here, before.z + 1.0, max(before.w, share));
}
