// Colours of the splats towards the camera, from their harmonics (twin: `shade` in raster/src/shade.rs). One thread per
// splat.
#import common
#import view
#import harmonics

// x: splats, y: degree of their harmonics.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> means: array<vec4f>;
@group(0) @binding(3) var<storage, read> seen: array<vec4f>;
// `[splat][basis function][r, g, b]`.
@group(0) @binding(4) var<storage, read> sh: array<f32>;
// Red, green, blue, and the 1 whose image is alpha.
@group(0) @binding(5) var<storage, read_write> colours: array<vec4f>;

@compute @workgroup_size(256)
fn shade(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    colours[i] = vec4f(0.0, 0.0, 0.0, 1.0);
    if !(seen[i].y > 0.0) {
        return;
    }
    let terms = (job.y + 1u) * (job.y + 1u);
    var b = basis(job.y, direction_to(view, means[i].xyz).xyz);
    var colour = vec3f(0.5);
    for (var k = 0u; k < terms; k += 1u) {
        let at = 3u * (i * terms + k);
        colour += b[k] * vec3f(sh[at], sh[at + 1u], sh[at + 2u]);
    }
    for (var c = 0u; c < 3u; c += 1u) {
        colours[i][c] = select(0.0, max(colour[c], 0.0), finite(colour[c]));
    }
}
