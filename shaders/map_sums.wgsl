// Gradients of a photo's maps: per pixel, the sum over the splats of a piece that read it (twin: `BilinearSample::add`
// in nn/src/sample.rs). Splats are sorted by the pixel up and to the left of where they read. One thread per map and
// pixel.
#import common
#import reader

// y: first splat of the piece.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> reader: Reader;
// Of `gsw_inputs`, sorted, and the original index of each.
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> items: array<u32>;
@group(0) @binding(4) var<storage, read> points: array<f32>;
// Of `gsw_inputs_backward`.
@group(0) @binding(5) var<storage, read> point_grads: array<f32>;
// Laid out as the photo's maps.
@group(0) @binding(6) var<storage, read_write> grads: array<f32>;

// The first item whose key is not below this one.
fn first_of(key: u32) -> u32 {
    var low = 0u;
    var high = (MAPS + 1u) * reader.capacity.x;
    while low < high {
        let middle = (low + high) / 2u;
        if keys[middle] < key {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}

@compute @workgroup_size(256)
fn map_sums(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let n = group_of(id, groups) * 256u + local;
    let pixels = reader.map.x * reader.map.y;
    let m = n / pixels;
    if m > MAPS {
        return;
    }
    let pixel = n % pixels;
    let at = vec2u(pixel % reader.map.x, pixel / reader.map.x);
    let capacity = reader.capacity.x;
    var sums: array<f32, SAMPLE>;
    for (var corner = 0u; corner < 4u; corner += 1u) {
        let by = vec2u(corner % 2u, corner / 2u);
        // None reads from the last row or column on.
        if any(at < by) || any(at - by > reader.map.xy - 2u) {
            continue;
        }
        let key = m * (pixels + 1u) + (at.y - by.y) * reader.map.x + at.x - by.x;
        let end = first_of(key + 1u);
        for (var item = first_of(key); item < end; item += 1u) {
            let k = items[item] - m * capacity;
            let share = vec2f(
                points[reader.more.x + 2u * m * capacity + k],
                points[reader.more.x + (2u * m + 1u) * capacity + k],
            );
            let each = select(1.0 - share, share, by == vec2u(1u));
            let weight = each.x * each.y;
            for (var s = 0u; s < SAMPLE; s += 1u) {
                sums[s] += weight * point_grads[reader.capacity.y + (m * SAMPLE + s) * capacity + k];
            }
        }
    }
    for (var s = 0u; s < SAMPLE; s += 1u) {
        let to = reader.map.z + (m * SAMPLE + s) * pixels + pixel;
        if job.y == 0u {
            grads[to] = sums[s];
        } else {
            grads[to] += sums[s];
        }
    }
}
