// Blends a tile's splats front to back (twin: `Blend` in raster/src/cpu/kernels.rs over `walk` in raster/src/cpu/tile.rs). A workgroup is a
// tile, a thread a pixel; entries are read a bucket at a time.
#import common
#import view
#import footprint

// x: 1 if this run writes alpha and the transmittance at the start of each bucket, which `gather` starts from.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> footprints: array<vec4f>;
@group(0) @binding(3) var<storage, read> entries: array<vec2u>;
@group(0) @binding(4) var<storage, read> tiles: array<vec4u>;
// BLOCKS vec4 per splat, and per pixel.
@group(0) @binding(5) var<storage, read> values: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> image: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> alpha: array<f32>;
// `[bucket][pixel of the tile]`.
@group(0) @binding(8) var<storage, read_write> transmittances: array<f32>;

var<workgroup> lit: atomic<u32>;
var<workgroup> print_p: array<vec4f, BUCKET>;
var<workgroup> print_q: array<vec4f, BUCKET>;
var<workgroup> value: array<vec4f, BUCKET * BLOCKS>;

@compute @workgroup_size(256)
fn blend(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let tile = group_of(id, groups);
    if tile >= view.frame.z * view.frame.w {
        return;
    }
    let range = tiles[tile];
    let at = pixel_of(tile, local, view.frame.z);
    let inside = at.x < view.frame.x && at.y < view.frame.y;
    let pixel = vec2f(at) + 0.5;
    var transmittance = select(0.0, 1.0, inside);
    var covered = 0.0;
    var sums: array<vec4f, BLOCKS>;

    var bucket = range.z;
    var next = range.x;
    for (; next < range.y; next += BUCKET) {
        if local == 0u {
            atomicStore(&lit, 0u);
        }
        workgroupBarrier();
        if transmittance >= T_MIN {
            atomicStore(&lit, 1u);
        }
        let count = min(BUCKET, range.y - next);
        let k = local % BUCKET;
        if k < count {
            let splat = entries[next + k].x;
            let lane = local / BUCKET;
            if lane == 0u {
                print_p[k] = footprints[2u * splat];
                print_q[k] = footprints[2u * splat + 1u];
            }
            if lane < BLOCKS {
                value[k * BLOCKS + lane] = values[splat * BLOCKS + lane];
            }
        }
        workgroupBarrier();
        if atomicLoad(&lit) == 0u {
            break;
        }
        if job.x == 1u {
            transmittances[bucket * PIXELS + local] = transmittance;
        }
        bucket += 1u;
        for (var i = 0u; i < count && transmittance >= T_MIN; i += 1u) {
            let hit = touch(footprint(print_p[i], print_q[i]), pixel);
            if hit.raw >= ALPHA_MIN {
                let weight = min(hit.raw, ALPHA_MAX) * transmittance;
                transmittance -= weight;
                covered += weight;
                for (var b = 0u; b < BLOCKS; b += 1u) {
                    sums[b] += weight * value[i * BLOCKS + b];
                }
            }
        }
        workgroupBarrier();
    }
    if job.x == 1u {
        // No light enters the rest.
        for (; next < range.y; next += BUCKET) {
            transmittances[bucket * PIXELS + local] = 0.0;
            bucket += 1u;
        }
    }
    if inside {
        let position = at.y * view.frame.x + at.x;
        if job.x == 1u {
            alpha[position] = covered;
        }
        for (var b = 0u; b < BLOCKS; b += 1u) {
            image[position * BLOCKS + b] = sums[b];
        }
    }
}
