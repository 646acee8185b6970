// SSIM of one channel and its derivatives by the render's mean, the sum of squares and the product (twin: `Across` in
// objective/src/losses.rs). A group per tile.
#import common
#import view
#import loss_inputs
#import window
#import sum

alias Summed = f32;

// x: tiles, y: the channel.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> shown: array<vec4f>;
@group(0) @binding(3) var<storage, read> photo: array<u32>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
// Three per pixel.
@group(0) @binding(5) var<storage, read_write> derivatives: array<vec4f>;
// Sum of the scores per channel and tile.
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
    let tile = group_of(id, groups);
    for (var k = local; k < WIDE * WIDE; k += 256u) {
        let position = position_of(tile, k, view.frame.z);
        var x = vec2f(0.0);
        if inside(position, view.frame) && tile < job.x {
            let i = u32(position.y) * view.frame.x + u32(position.x);
            x = weights[i] * vec2f(shown[i][job.y], colour_of(photo[i])[job.y]);
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
    let there = inside(position, view.frame) && tile < job.x;
    if there {
        let by_mean = 2.0 * m.y * (a2 - a1) * inverse - 2.0 * m.x * similarity * (b2 - b1) * inverse;
        let by_squares = -similarity * b1 * inverse;
        let by_product = 2.0 * a1 * inverse;
        derivatives[u32(position.y) * view.frame.x + u32(position.x)] = vec4f(by_mean, by_squares, by_product, 0.0);
    }
    let score = sum_of_group(local, select(0.0, similarity, there));
    if local == 0u && tile < job.x {
        parts[job.y * job.x + tile] = score;
    }
}
