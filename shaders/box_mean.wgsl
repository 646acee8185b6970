// Mean over a window along rows or columns, cut off at the border (twin: `box_mean` in scene/src/window.rs, which does
// both). One thread per pixel.
#import common

// x: width, y: height, z: half width of the window, w: 1 along columns.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> means: array<f32>;

@compute @workgroup_size(256)
fn box_mean(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x * job.y {
        return;
    }
    var at = i % job.x;
    var size = job.x;
    var stride = 1u;
    if job.w == 1u {
        at = i / job.x;
        size = job.y;
        stride = job.x;
    }
    let first = at - min(at, job.z);
    let end = min(at + job.z + 1u, size);
    let start = i - at * stride;
    var sum = 0.0;
    for (var k = first; k < end; k += 1u) {
        sum += values[start + k * stride];
    }
    means[i] = sum / f32(end - first);
}
