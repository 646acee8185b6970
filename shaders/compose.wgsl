// A frame over its background in the colours of its photo, and its residual (twin: `compose` in
// objective/src/compare.rs). One thread per pixel.
#import common
#import view
#import loss_inputs
#import background

// x: pixels, y: 1 if there is a trust per pixel.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<uniform> loss_inputs: LossInputs;
// Colour and alpha.
@group(0) @binding(3) var<storage, read> image: array<vec4f>;
@group(0) @binding(4) var<storage, read> photo: array<u32>;
@group(0) @binding(5) var<storage, read> trust: array<f32>;
// In the photo's colours, and the mean absolute difference.
@group(0) @binding(6) var<storage, read_write> shown: array<vec4f>;
// That difference times one minus the trust of the pixel.
@group(0) @binding(7) var<storage, read_write> uncertain: array<f32>;

@compute @workgroup_size(256)
fn compose(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    let rendered = image[i];
    var colour = rendered.xyz + (1.0 - rendered.w) * background(view, loss_inputs, i);
    if loss_inputs.modes.y == 1u {
        let scene = vec4f(colour, 1.0);
        for (var c = 0u; c < 3u; c += 1u) {
            colour[c] = dot(loss_inputs.matrix[c], scene);
        }
    }
    let apart = abs(colour - colour_of(photo[i])) * (1.0 / 3.0);
    let residual = apart.x + apart.y + apart.z;
    shown[i] = vec4f(colour, residual);
    var uncertainty = 1.0;
    if job.y == 1u {
        uncertainty = 1.0 - trust[i];
    }
    uncertain[i] = residual * uncertainty;
}
