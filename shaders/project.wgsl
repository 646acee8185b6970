// From splats to footprints on the image (twin: `Projector::shape` in raster/src/cpu/project.rs). One thread per splat.
#import common
#import view
#import footprint
#import cover
#import path

// x: splats.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
// Centre, and the opacity's logit.
@group(0) @binding(2) var<storage, read> means: array<vec4f>;
@group(0) @binding(3) var<storage, read> log_scales: array<vec4f>;
@group(0) @binding(4) var<storage, read> rotations: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> footprints: array<vec4f>;
// Depth, radius, centre.
@group(0) @binding(6) var<storage, read_write> seen: array<vec4f>;
// Tiles the splat touches; 0 for a culled one.
@group(0) @binding(7) var<storage, read_write> counts: array<u32>;
// Sort key of DEPTH_BITS bits: those of its depth, which have the order of the depths since these are positive, above
// those of the nearest.
@group(0) @binding(8) var<storage, read_write> keys: array<u32>;
@group(0) @binding(9) var<storage, read_write> order: array<u32>;

// The key of culled splats.
const LAST_KEY: u32 = (1u << DEPTH_BITS) - 1u;
// Where the nearest depth is 0, this one's key is the first.
const LEAST_DEPTH: f32 = 1e-6;

@compute @workgroup_size(256)
fn project(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    let mean = means[i];
    let p = path_of(view, mean, log_scales[i].xyz, rotations[i]);
    let z = p.cam.z;
    let x = view.lens.x * p.cam.x / z + view.lens.z;
    let y = view.lens.y * p.cam.y / z + view.lens.w;
    seen[i] = vec4f(select(0.0, z, finite(z)), 0.0, x, y);
    counts[i] = 0u;
    keys[i] = LAST_KEY;
    order[i] = i;
    if !p.good {
        return;
    }
    let opacity = opacity_of(view, p);
    if opacity < ALPHA_MIN {
        return;
    }
    let lo = log2(opacity);
    let a = HALF_LOG2_E * (p.syy / p.det);
    let e = HALF_LOG2_E / p.syy;
    // Twice the natural logarithm of how far the peak stands above the threshold: the largest q blended.
    let q = max((lo - LOG2_ALPHA_MIN) / HALF_LOG2_E, 0.0);
    let reach_x = sqrt(q * p.sxx) + SLACK;
    let reach_y = sqrt(q * p.syy) + SLACK;
    let half_gap = 0.5 * (p.sxx - p.syy);
    let largest = 0.5 * (p.sxx + p.syy) + sqrt(half_gap * half_gap + p.sxy * p.sxy);
    let radius = sqrt(q * largest);
    let f = Footprint(x, y, p.sxy / p.syy, a, e, lo, 1.0 / a, reach_y);
    let tip = tip_of(f);
    let width = view.frame.x;
    let height = view.frame.y;
    let inside = x + reach_x >= 0.5 && x - reach_x <= f32(width) - 0.5
        && y + reach_y >= 0.5 && y - reach_y <= f32(height) - 0.5;
    let numbers = finite4(vec4f(x, y, f.slope, a)) && finite4(vec4f(e, lo, f.inv_a, reach_y))
        && finite(radius) && finite(tip) && finite(reach_x);
    if !(numbers && a > 0.0 && inside) {
        return;
    }
    seen[i].y = radius;
    footprints[2u * i] = vec4f(f.x, f.y, f.slope, f.a);
    footprints[2u * i + 1u] = vec4f(f.e, f.lo, f.inv_a, f.reach);

    let rows = rows_of(f, height);
    if rows.x > rows.y {
        return;
    }
    var count = 0u;
    for (var row = u32(rows.x) / TILE; row <= u32(rows.y) / TILE; row += 1u) {
        let columns = columns_of(f, tip, rows, row, width);
        count += columns.y - columns.x;
    }
    if count > 0u {
        counts[i] = count;
        let nearest = max(view.options.z, LEAST_DEPTH);
        keys[i] = min(bitcast<u32>(max(z, nearest)) - bitcast<u32>(nearest), LAST_KEY - 1u);
    }
}
