// Weights of the pixels: outliers are left out where most of their neighbours are outliers (twins: `leave_out` in
// objective/src/transients/residuals.rs, `pixel_weights` and `weighted_psnr` in objective/src/compare.rs). One thread per
// pixel.
#import common
#import loss_inputs
#import bins
#import sum

alias Summed = vec4f;

// x: width, y: height.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> loss_inputs: LossInputs;
@group(0) @binding(2) var<storage, read> photo: array<u32>;
@group(0) @binding(3) var<storage, read> smoothed: array<f32>;
@group(0) @binding(4) var<storage, read> limits: array<f32>;
// In the photo's colours, and the residual.
@group(0) @binding(5) var<storage, read> shown: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> weights: array<f32>;
// The residual where it counts.
@group(0) @binding(7) var<storage, read_write> counted: array<f32>;
// Per group: pixels that count, the weight left of them, and their squared errors.
@group(0) @binding(8) var<storage, read_write> parts: array<vec4f>;

fn stands_out(i: u32) -> u32 {
    let pixel = photo[i];
    let limit = limits[select(0u, 1u, has(pixel, INITIAL_TRANSIENT))];
    return u32(has(pixel, COUNTS) && bin_top(bin_of(smoothed[i])) > limit);
}

// Whether most of the pixels around one are outliers; at the border, of those inside the frame.
fn voted_out(i: u32) -> bool {
    let x = i % job.x;
    let y = i / job.x;
    let low = vec2u(x - min(x, 1u), y - min(y, 1u));
    let high = vec2u(min(x + 2u, job.x), min(y + 2u, job.y));
    var votes = 0u;
    for (var v = low.y; v < high.y; v += 1u) {
        for (var u = low.x; u < high.x; u += 1u) {
            votes += stands_out(v * job.x + u);
        }
    }
    return 2u * votes > (high.x - low.x) * (high.y - low.y);
}

@compute @workgroup_size(256)
fn pixel_weights(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let i = group * 256u + local;
    var mine = vec4f(0.0);
    if i < job.x * job.y {
        let pixel = photo[i];
        let counts = has(pixel, COUNTS);
        var kept = true;
        if loss_inputs.modes.z == LEAVE_INITIAL_TRANSIENTS {
            kept = !has(pixel, INITIAL_TRANSIENT);
        } else if loss_inputs.modes.z == LEAVE_RESIDUALS {
            kept = !voted_out(i);
        }
        let weight = f32(counts && kept);
        let error = shown[i].xyz - colour_of(pixel);
        weights[i] = weight;
        counted[i] = weight * shown[i].w;
        mine = vec4f(f32(counts), weight, weight * dot(error, error), 0.0);
    }
    let sum = sum_of_group(local, mine);
    if local == 0u && group * 256u < job.x * job.y {
        parts[group] = sum;
    }
}
