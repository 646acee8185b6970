// Sums by which a photo pulls the one background colour (twin: `ColourSums::of` in objective/src/background.rs).
// One thread per pixel.
#import common
#import loss_inputs
#import sum

alias Summed = vec4f;

// x: pixels.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> image: array<vec4f>;
@group(0) @binding(2) var<storage, read> photo: array<u32>;
@group(0) @binding(3) var<storage, read> shown: array<vec4f>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
// Per group: the pull, and the sum of its weights.
@group(0) @binding(5) var<storage, read_write> parts: array<vec4f>;

@compute @workgroup_size(256)
fn colour_sums(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let i = group * 256u + local;
    var mine = vec4f(0.0);
    if i < job.x {
        let open = 1.0 - image[i].w;
        mine = weights[i] * open * vec4f(colour_of(photo[i]) - shown[i].xyz, open);
    }
    let sum = sum_of_group(local, mine);
    if local == 0u && group * 256u < job.x {
        parts[group] = sum;
    }
}
