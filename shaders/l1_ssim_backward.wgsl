// Gradient of the loss by each channel of the shown colours, from SSIM's derivatives and the absolute difference (twin:
// `GradientPass` in objective/src/losses.rs). A group per channel and tile.
#import common
#import view
#import loss_inputs
#import window
#import sum

alias Summed = f32;

// x: tiles, y: pixels.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<uniform> loss_inputs: LossInputs;
@group(0) @binding(3) var<storage, read> shown: array<vec4f>;
@group(0) @binding(4) var<storage, read> photo: array<u32>;
@group(0) @binding(5) var<storage, read> weights: array<f32>;
@group(0) @binding(6) var<storage, read> derivatives: array<f32>;
// Channel by channel.
@group(0) @binding(7) var<storage, read_write> by_shown: array<f32>;
// Sum of the scores of `ssim` and of the absolute differences, per channel and tile.
@group(0) @binding(8) var<storage, read_write> parts: array<f32>;

// Three numbers each, plane by plane: vec3f would take the space of four.
var<workgroup> near: array<f32, 3 * WIDE * WIDE>;
var<workgroup> along: array<f32, 3 * WIDE * TILE>;

fn near_at(k: u32) -> vec3f {
    return vec3f(near[k], near[WIDE * WIDE + k], near[2u * WIDE * WIDE + k]);
}

fn along_at(k: u32) -> vec3f {
    return vec3f(along[k], along[WIDE * TILE + k], along[2u * WIDE * TILE + k]);
}

@compute @workgroup_size(256)
fn l1_ssim_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let channel = group / job.x;
    let tile = group % job.x;
    for (var k = local; k < WIDE * WIDE; k += 256u) {
        let position = position_of(tile, k, view.frame.z);
        var x = vec3f(0.0);
        if inside(position, view.frame) && channel < 3u {
            let i = 3u * channel * job.y + u32(position.y) * view.frame.x + u32(position.x);
            x = vec3f(derivatives[i], derivatives[i + job.y], derivatives[i + 2u * job.y]);
        }
        near[k] = x.x;
        near[WIDE * WIDE + k] = x.y;
        near[2u * WIDE * WIDE + k] = x.z;
    }
    workgroupBarrier();
    for (var k = local; k < WIDE * TILE; k += 256u) {
        let middle = (k / TILE) * WIDE + k % TILE + REACH;
        var sum = WINDOW[0] * near_at(middle);
        for (var tap = 1u; tap <= REACH; tap += 1u) {
            sum += WINDOW[tap] * (near_at(middle - tap) + near_at(middle + tap));
        }
        along[k] = sum.x;
        along[WIDE * TILE + k] = sum.y;
        along[2u * WIDE * TILE + k] = sum.z;
    }
    workgroupBarrier();
    let position = position_of(tile, (local / TILE + REACH) * WIDE + local % TILE + REACH, view.frame.z);
    var apart = 0.0;
    if inside(position, view.frame) && channel < 3u {
        let middle = local + REACH * TILE;
        var by = WINDOW[0] * along_at(middle);
        for (var tap = 1u; tap <= REACH; tap += 1u) {
            by += WINDOW[tap] * (along_at(middle - tap * TILE) + along_at(middle + tap * TILE));
        }
        let i = u32(position.y) * view.frame.x + u32(position.x);
        let weight = weights[i];
        let x = weight * shown[i][channel];
        let y = weight * colour_of(photo[i])[channel];
        let d = x - y;
        apart = abs(d);
        let count = 3.0 * f32(job.y);
        let lambda = loss_inputs.numbers.x;
        let by_difference = (1.0 - lambda) / count * (f32(d > 0.0) - f32(d < 0.0));
        let by_score = -lambda / count * (by.x + 2.0 * x * by.y + y * by.z);
        by_shown[channel * job.y + i] = weight * (by_difference + by_score);
    }
    let difference = sum_of_group(local, apart);
    if local == 0u && channel < 3u {
        parts[2u * group + 1u] = difference;
    }
}
