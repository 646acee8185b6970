// Weights of a photo's pixels by its visibility map, and how much the map and the robust mask leave out (twins:
// `visibility_weights` and `is_plausible` in objective/src/transients/visibility.rs). One thread per pixel.
#import common
#import loss_inputs
#import sum

alias Summed = vec4f;

// x: the photo's width and height, y: the map's, 16 bits each, z: where the map starts.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> photo: array<u32>;
@group(0) @binding(2) var<storage, read> maps: array<f32>;
// Of `pixel_weights`.
@group(0) @binding(3) var<storage, read> weights: array<f32>;
@group(0) @binding(4) var<storage, read_write> seen: array<f32>;
// Per group: pixels that count, the weight that the map leaves out, and that of the mask.
@group(0) @binding(5) var<storage, read_write> parts: array<vec4f>;

fn map_at(x: u32, y: u32, width: u32) -> f32 {
    return 1.0 / (1.0 + exp(-maps[job.z + y * width + x]));
}

@compute @workgroup_size(256)
fn visibility_weights(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let i = group * 256u + local;
    let size = vec2u(job.x & 0xffffu, job.x >> 16u);
    let map = vec2u(job.y & 0xffffu, job.y >> 16u);
    let pixels = size.x * size.y;
    var mine = vec4f(0.0);
    if i < pixels {
        let pixel = vec2f(vec2u(i % size.x, i / size.x));
        let at = max((pixel + 0.5) / vec2f(size) * vec2f(map) - 0.5, vec2f(0.0));
        let low = vec2u(at);
        let high = min(low + 1u, map - 1u);
        let share = at - vec2f(low);
        let upper = mix(map_at(low.x, low.y, map.x), map_at(high.x, low.y, map.x), share.x);
        let lower = mix(map_at(low.x, high.y, map.x), map_at(high.x, high.y, map.x), share.x);
        let weight = clamp((mix(upper, lower, share.y) - OCCLUDED) / (SURE - OCCLUDED), 0.0, 1.0);
        seen[i] = weight;
        if has(photo[i], COUNTS) {
            mine = vec4f(1.0, 1.0 - weight, 1.0 - weights[i], 0.0);
        }
    }
    let sum = sum_of_group(local, mine);
    if local == 0u && group * 256u < pixels {
        parts[group] = sum;
    }
}
