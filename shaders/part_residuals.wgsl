// Mean residual of each part of a photo, relative to the limit for transients (twin: `part_residuals` in
// objective/src/transients/visibility.rs). One thread per part.
#import common
#import loss_inputs

// x: the photo's width, y: its height, z: the map's, w: its height.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> photo: array<u32>;
@group(0) @binding(2) var<storage, read> smoothed: array<f32>;
// Of `residual_limits`; the third is that of this visit alone.
@group(0) @binding(3) var<storage, read> limits: array<f32>;
// Below 0 where no pixel counts.
@group(0) @binding(4) var<storage, read_write> residuals: array<f32>;

@compute @workgroup_size(256)
fn part_residuals(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    if k >= job.z * job.w {
        return;
    }
    let part = vec2u(k % job.z, k / job.z);
    let low = (part * job.xy + job.zw - 1u) / job.zw;
    let high = ((part + 1u) * job.xy + job.zw - 1u) / job.zw;
    var sum = 0.0;
    var many = 0u;
    for (var y = low.y; y < high.y; y += 1u) {
        for (var x = low.x; x < high.x; x += 1u) {
            let i = y * job.x + x;
            if has(photo[i], COUNTS) {
                sum += min(smoothed[i] / limits[2], WRONG);
                many += 1u;
            }
        }
    }
    residuals[k] = select(-1.0, sum / f32(many), many > 0u);
}
