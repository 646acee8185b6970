// From the gradients of the small networks' inputs to those of the splats' embeddings. The gradients of the samples
// stay where they are, for `map_sums` (twin: `piece_backward` in objective/src/appearance/gsw/points.rs). One thread per
// splat.
#import common
#import reader

// x: splats, y: first of the piece.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> reader: Reader;
@group(0) @binding(2) var<storage, read> splats: array<u32>;
@group(0) @binding(3) var<storage, read> count: array<u32>;
@group(0) @binding(4) var<storage, read> splat_embeddings: array<f32>;
@group(0) @binding(5) var<storage, read> maps: array<f32>;
// Laid out as the planes of splats.
@group(0) @binding(6) var<storage, read_write> point_grads: array<f32>;
@group(0) @binding(7) var<storage, read_write> embedding_grads: array<f32>;

@compute @workgroup_size(256)
fn gsw_inputs_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    let capacity = reader.capacity.x;
    if k >= capacity || job.y + k >= count[0] {
        return;
    }
    let i = splats[job.y + k];
    for (var c = 0u; c < INTRINSIC; c += 1u) {
        let to_light = point_grads[reader.capacity.y + (DYNAMIC + c) * capacity + k];
        let to_vector = point_grads[reader.capacity.z + (reader.more.y + c) * capacity + k];
        embedding_grads[i * EMBEDDING_SIZE + c] = to_vector + to_light;
    }
    let pixels = reader.map.x * reader.map.y;
    for (var m = 0u; m <= MAPS; m += 1u) {
        var at = vec2f(0.0);
        var grad = vec2f(0.0);
        if reader.map.w == 1u {
            let embedding = i * EMBEDDING_SIZE + INTRINSIC + 2u * m;
            if m < MAPS {
                at = vec2f(splat_embeddings[embedding], splat_embeddings[embedding + 1u]) * COORDINATE;
            }
            let spot = spot_at(reader, at);
            let first = spot.pixel.y * reader.map.x + spot.pixel.x;
            for (var s = 0u; s < SAMPLE; s += 1u) {
                let d = m * SAMPLE + s;
                let here = reader.capacity.y + d * capacity + k;
                let g = point_grads[here] * kept(reader, i, d);
                point_grads[here] = g;
                if m < MAPS {
                    let base = reader.map.z + d * pixels + first;
                    let upper = vec2f(maps[base], maps[base + 1u]);
                    let lower = vec2f(maps[base + reader.map.x], maps[base + reader.map.x + 1u]);
                    let right = mix(upper.y - upper.x, lower.y - lower.x, spot.share.y);
                    let down = mix(lower.x - upper.x, lower.y - upper.y, spot.share.x);
                    grad += g * vec2f(right, down) * spot.slope;
                }
            }
            grad += select(vec2f(0.0), reader.frame.w * sign(at), abs(at) > vec2f(1.0));
        }
        if m < MAPS {
            embedding_grads[i * EMBEDDING_SIZE + INTRINSIC + 2u * m] = COORDINATE * grad.x;
            embedding_grads[i * EMBEDDING_SIZE + INTRINSIC + 2u * m + 1u] = COORDINATE * grad.y;
        }
    }
}
