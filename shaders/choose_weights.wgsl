// Replaces the robust mask's weights by those of the visibility map, where these are plausible (twin: `is_plausible` in
// objective/src/transients/visibility.rs). One thread per pixel.
#import common
#import loss_inputs
#import sum

alias Summed = vec4f;

// x: pixels.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> loss_inputs: LossInputs;
@group(0) @binding(2) var<storage, read> photo: array<u32>;
@group(0) @binding(3) var<storage, read> seen: array<f32>;
// Totals of `visibility_weights`.
@group(0) @binding(4) var<storage, read> left_out: array<f32>;
// In the photo's colours, and the residual.
@group(0) @binding(5) var<storage, read> shown: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> weights: array<f32>;
@group(0) @binding(7) var<storage, read_write> counted: array<f32>;
// As in `pixel_weights`.
@group(0) @binding(8) var<storage, read_write> parts: array<vec4f>;

@compute @workgroup_size(256)
fn choose_weights(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let i = group * 256u + local;
    let many = max(left_out[0], 1.0);
    let own = left_out[1] / many;
    let plausible = finite(own) && own <= MOST * loss_inputs.numbers.z && own >= LEAST * left_out[2] / many;
    var mine = vec4f(0.0);
    if i < job.x {
        let counts = f32(has(photo[i], COUNTS));
        let weight = select(weights[i], counts * seen[i], plausible);
        let error = shown[i].xyz - colour_of(photo[i]);
        weights[i] = weight;
        counted[i] = weight * shown[i].w;
        mine = vec4f(counts, weight, weight * dot(error, error), 0.0);
    }
    let sum = sum_of_group(local, mine);
    if local == 0u && group * 256u < job.x {
        parts[group] = sum;
    }
}
