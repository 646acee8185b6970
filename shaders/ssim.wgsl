// SSIM of each channel and its derivatives by the render's mean, the sum of squares and the product (twin: `Across` in
// objective/src/losses.rs). A group per channel and tile.
#import common
#import view
#import loss_inputs
#import window
#import sum

alias Summed = f32;

// x: tiles, y: pixels.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> shown: array<vec4f>;
@group(0) @binding(3) var<storage, read> photo: array<u32>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
// Three planes per channel.
@group(0) @binding(5) var<storage, read_write> derivatives: array<f32>;
// Sum of the scores per channel and tile, and what `l1_ssim_backward` adds.
@group(0) @binding(6) var<storage, read_write> parts: array<f32>;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

// The two images around the tile.
var<workgroup> pair: array<vec2f, WIDE * WIDE>;
// Means, sum of squares and product, averaged along rows.
var<workgroup> along: array<vec4f, WIDE * TILE>;

fn maps(x: vec2f) -> vec4f {
    return vec4f(x, dot(x, x), x.x * x.y);
}

@compute @workgroup_size(256)
fn ssim(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let channel = group / job.x;
    let tile = group % job.x;
    for (var k = local; k < WIDE * WIDE; k += 256u) {
        let position = position_of(tile, k, view.frame.z);
        var x = vec2f(0.0);
        if inside(position, view.frame) && channel < 3u {
            let i = u32(position.y) * view.frame.x + u32(position.x);
            x = weights[i] * vec2f(shown[i][channel], colour_of(photo[i])[channel]);
        }
        pair[k] = x;
    }
    workgroupBarrier();
    for (var k = local; k < WIDE * TILE; k += 256u) {
        let middle = (k / TILE) * WIDE + k % TILE + REACH;
        var sum = WINDOW[0] * maps(pair[middle]);
        for (var tap = 1u; tap <= REACH; tap += 1u) {
            sum += WINDOW[tap] * (maps(pair[middle - tap]) + maps(pair[middle + tap]));
        }
        along[k] = sum;
    }
    workgroupBarrier();
    let middle = local + REACH * TILE;
    var m = WINDOW[0] * along[middle];
    for (var tap = 1u; tap <= REACH; tap += 1u) {
        m += WINDOW[tap] * (along[middle - tap * TILE] + along[middle + tap * TILE]);
    }
    let product = m.x * m.y;
    let squares = m.x * m.x + m.y * m.y;
    let a1 = 2.0 * product + C1;
    let a2 = 2.0 * (m.w - product) + C2;
    let b1 = squares + C1;
    // Rounding may leave a tiny negative variance in flat parts.
    let b2 = max(m.z - squares, 0.0) + C2;
    let inverse = 1.0 / (b1 * b2);
    let similarity = a1 * a2 * inverse;
    let position = position_of(tile, (local / TILE + REACH) * WIDE + local % TILE + REACH, view.frame.z);
    let there = inside(position, view.frame) && channel < 3u;
    if there {
        let by_mean = 2.0 * m.y * (a2 - a1) * inverse - 2.0 * m.x * similarity * (b2 - b1) * inverse;
        let by_squares = -similarity * b1 * inverse;
        let by_product = 2.0 * a1 * inverse;
        let i = 3u * channel * job.y + u32(position.y) * view.frame.x + u32(position.x);
        derivatives[i] = by_mean;
        derivatives[i + job.y] = by_squares;
        derivatives[i + 2u * job.y] = by_product;
    }
    let score = sum_of_group(local, select(0.0, similarity, there));
    if local == 0u && channel < 3u {
        parts[2u * group] = score;
    }
}
