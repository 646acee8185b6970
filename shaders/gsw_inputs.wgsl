// Inputs of the small networks for a piece of splats: dynamic features sampled from the photo's maps, intrinsic
// features, encoded positions and viewing directions (twins: `run`, `encode` and `direction` in
// objective/src/appearance/gsw/points.rs). One thread per splat.
#import common
#import reader

// x: splats, y: first of the piece.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> reader: Reader;
@group(0) @binding(2) var<storage, read> splats: array<u32>;
@group(0) @binding(3) var<storage, read> count: array<u32>;
// Centre and opacity.
@group(0) @binding(4) var<storage, read> means: array<vec4f>;
@group(0) @binding(5) var<storage, read> splat_embeddings: array<f32>;
// Of the photo.
@group(0) @binding(6) var<storage, read> maps: array<f32>;
// Planes of splats.
@group(0) @binding(7) var<storage, read_write> points: array<f32>;
// `[map][splat of the piece]`: the map and the pixel that is read there.
@group(0) @binding(8) var<storage, read_write> keys: array<u32>;
// The index of each of these.
@group(0) @binding(9) var<storage, read_write> items: array<u32>;

fn put(plane: u32, first: u32, k: u32, value: f32) {
    points[first + plane * reader.capacity.x + k] = value;
}

@compute @workgroup_size(256)
fn gsw_inputs(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    let capacity = reader.capacity.x;
    if k >= capacity {
        return;
    }
    let pixels = reader.map.x * reader.map.y;
    let there = job.y + k < count[0];
    if reader.map.w == 1u {
        for (var m = 0u; m <= MAPS; m += 1u) {
            keys[m * capacity + k] = m * (pixels + 1u) + pixels;
            items[m * capacity + k] = m * capacity + k;
        }
    }
    if !there {
        return;
    }
    let i = splats[job.y + k];
    let mean = means[i].xyz;
    for (var d = 0u; d < DYNAMIC; d += 1u) {
        put(d, reader.capacity.y, k, 0.0);
    }
    if reader.map.w == 1u {
        for (var m = 0u; m <= MAPS; m += 1u) {
            var spot = spot_of(reader, mean);
            if m < MAPS {
                let at = i * EMBEDDING_SIZE + INTRINSIC + 2u * m;
                spot = spot_at(reader, vec2f(splat_embeddings[at], splat_embeddings[at + 1u]) * COORDINATE);
            }
            if !spot.there {
                continue;
            }
            let first = spot.pixel.y * reader.map.x + spot.pixel.x;
            keys[m * capacity + k] = m * (pixels + 1u) + first;
            put(2u * m, reader.more.x, k, spot.share.x);
            put(2u * m + 1u, reader.more.x, k, spot.share.y);
            let far = spot.share;
            let near = 1.0 - far;
            let weight = vec4f(near.y * near.x, near.y * far.x, far.y * near.x, far.y * far.x);
            for (var s = 0u; s < SAMPLE; s += 1u) {
                let d = m * SAMPLE + s;
                let at = reader.map.z + d * pixels + first;
                let seen = vec4f(maps[at], maps[at + 1u], maps[at + reader.map.x], maps[at + reader.map.x + 1u]);
                put(d, reader.capacity.y, k, dot(weight, seen) * kept(reader, i, d));
            }
        }
    }
    for (var c = 0u; c < INTRINSIC; c += 1u) {
        let made_of = splat_embeddings[i * EMBEDDING_SIZE + c];
        put(DYNAMIC + c, reader.capacity.y, k, made_of);
        put(reader.more.y + c, reader.capacity.z, k, made_of);
    }
    let encoded = DYNAMIC + INTRINSIC;
    for (var axis = 0u; axis < 3u; axis += 1u) {
        put(encoded + axis, reader.capacity.y, k, mean[axis]);
        // Each octave from the one below by the double angle.
        var s = sin(mean[axis]);
        var c = cos(mean[axis]);
        for (var octave = 0u; octave < reader.more.z; octave += 1u) {
            put(encoded + 3u + 6u * octave + 2u * axis, reader.capacity.y, k, s);
            put(encoded + 4u + 6u * octave + 2u * axis, reader.capacity.y, k, c);
            let twice = 2.0 * s * c;
            c = 1.0 - 2.0 * s * s;
            s = twice;
        }
    }
    let to = mean - reader.eye.xyz;
    let direction = to / max(length(to), 1e-12);
    for (var axis = 0u; axis < 3u; axis += 1u) {
        put(VECTOR + axis, reader.capacity.w, k, direction[axis]);
    }
}
