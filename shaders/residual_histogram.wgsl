// Histogram of the residuals (twin: `leave_out` in objective/src/transients/residuals.rs). One thread per pixel.
#import common
#import loss_inputs
#import bins

// x: pixels.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> photo: array<u32>;
@group(0) @binding(2) var<storage, read> smoothed: array<f32>;
// BINS of them, 0 before.
@group(0) @binding(3) var<storage, read_write> counts: array<atomic<u32>>;

var<workgroup> here: array<atomic<u32>, BINS>;

@compute @workgroup_size(256)
fn residual_histogram(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    if local < BINS {
        atomicStore(&here[local], 0u);
    }
    workgroupBarrier();
    let i = group_of(id, groups) * 256u + local;
    if i < job.x && has(photo[i], COUNTS) {
        atomicAdd(&here[bin_of(smoothed[i])], 1u);
    }
    workgroupBarrier();
    if local < BINS {
        let found = atomicLoad(&here[local]);
        if found > 0u {
            // Whole numbers: their sum does not depend on the order.
            atomicAdd(&counts[local], found);
        }
    }
}
