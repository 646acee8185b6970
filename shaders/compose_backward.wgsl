// From the gradient of the shown colours to those of the blended image, of its alpha and of the photo's matrix (twins:
// `matrix_backward` in objective/src/appearance/affine.rs, `alpha_gradient` in objective/src/compare.rs). One thread per
// pixel.
#import common
#import view
#import loss_inputs
#import background
#import sum

alias Summed = vec4f;

// x: pixels.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<uniform> loss_inputs: LossInputs;
@group(0) @binding(3) var<storage, read> image: array<vec4f>;
@group(0) @binding(4) var<storage, read> photo: array<u32>;
// Channel by channel.
@group(0) @binding(5) var<storage, read> by_shown: array<f32>;
// Of colour and alpha.
@group(0) @binding(6) var<storage, read_write> grads: array<vec4f>;
// Per group, of the matrix's rows.
@group(0) @binding(7) var<storage, read_write> parts: array<vec4f>;

@compute @workgroup_size(256)
fn compose_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let i = group * 256u + local;
    let there = i < job.x;
    var g = vec3f(0.0);
    var scene = vec4f(0.0);
    if there {
        let rendered = image[i];
        let back = background(view, loss_inputs, i);
        g = vec3f(by_shown[i], by_shown[job.x + i], by_shown[2u * job.x + i]);
        scene = vec4f(rendered.xyz + (1.0 - rendered.w) * back, 1.0);
        var by_scene = g;
        if loss_inputs.modes.y == 1u {
            by_scene = g.x * loss_inputs.matrix[0].xyz + g.y * loss_inputs.matrix[1].xyz + g.z * loss_inputs.matrix[2].xyz;
        }
        var by_alpha = -dot(by_scene, back);
        if has(photo[i], INNER) {
            by_alpha += loss_inputs.numbers.y / max(1.0 - rendered.w, LEAST_OPEN);
        }
        grads[i] = vec4f(by_scene, by_alpha);
    }
    if loss_inputs.modes.y != 1u {
        return;
    }
    for (var c = 0u; c < 3u; c += 1u) {
        let sum = sum_of_group(local, g[c] * scene);
        if local == 0u && group * 256u < job.x {
            parts[3u * group + c] = sum;
        }
    }
}
