// From the gradients of the colours to those of the harmonics and, through the direction, of the centres (twin:
// `shade_backward` in raster/src/shade.rs). One thread per splat.
#import common
#import view
#import harmonics

// x: splats, y: degree of their harmonics.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> means: array<vec4f>;
@group(0) @binding(3) var<storage, read> seen: array<vec4f>;
@group(0) @binding(4) var<storage, read> sh: array<f32>;
// Gradients of the colours, and of alpha.
@group(0) @binding(5) var<storage, read> sums: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> sh_grads: array<f32>;
// Output of `project_backward`; the gradient through the direction is added to the mean's.
@group(0) @binding(7) var<storage, read_write> grads: array<vec4f>;

@compute @workgroup_size(256)
fn shade_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    let degree = job.y;
    let terms = (degree + 1u) * (degree + 1u);
    let at_first = 3u * i * terms;
    if !(seen[i].y > 0.0) {
        for (var k = 0u; k < 3u * terms; k += 1u) {
            sh_grads[at_first + k] = 0.0;
        }
        return;
    }
    let direction = direction_to(view, means[i].xyz);
    var b = basis(degree, direction.xyz);
    var raw = vec3f(0.5);
    for (var k = 0u; k < terms; k += 1u) {
        let at = at_first + 3u * k;
        raw += b[k] * vec3f(sh[at], sh[at + 1u], sh[at + 2u]);
    }
    var g = sums[i].xyz;
    for (var c = 0u; c < 3u; c += 1u) {
        // A colour held at 0 takes no gradient.
        g[c] = select(0.0, g[c], raw[c] > 0.0 && finite(raw[c]) && finite(g[c]));
    }
    var by_basis: array<f32, 16>;
    for (var k = 0u; k < terms; k += 1u) {
        let at = at_first + 3u * k;
        by_basis[k] = dot(vec3f(sh[at], sh[at + 1u], sh[at + 2u]), g);
        sh_grads[at] = b[k] * g.x;
        sh_grads[at + 1u] = b[k] * g.y;
        sh_grads[at + 2u] = b[k] * g.z;
    }
    if degree == 0u {
        return;
    }
    let d = basis_backward(degree, direction.xyz, by_basis);
    let moved = (d - direction.xyz * dot(d, direction.xyz)) * direction.w;
    if finite3(moved) {
        grads[4u * i] += vec4f(moved, 0.0);
    }
}
