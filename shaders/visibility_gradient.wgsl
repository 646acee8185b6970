// Gradient of the visibility head's plane (twin: `visibility_gradient` in objective/src/appearance/gsw/mod.rs). One workgroup.
#import common
#import sum

alias Summed = f32;

// x: parts of the photo, y: where the plane starts, z: 1 if there are residuals of the parts.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> residuals: array<f32>;
@group(0) @binding(2) var<storage, read> maps: array<f32>;
// Laid out as the maps.
@group(0) @binding(3) var<storage, read_write> grads: array<f32>;

@compute @workgroup_size(256)
fn visibility_gradient(@builtin(local_invocation_index) local: u32) {
    var mine = 0.0;
    for (var k = local; k < job.x; k += 256u) {
        mine += f32(job.z == 1u && residuals[k] >= 0.0);
    }
    let known = max(sum_of_group(local, mine), 1.0);
    for (var k = local; k < job.x; k += 256u) {
        var grad = 0.0;
        if job.z == 1u && residuals[k] >= 0.0 {
            let v = 1.0 / (1.0 + exp(-maps[job.y + k]));
            grad = VISIBILITY / known * (clamp(residuals[k], 0.0, 2.0) - 2.0 * (1.0 - v)) * v * (1.0 - v);
        }
        grads[job.y + k] = grad;
    }
}
