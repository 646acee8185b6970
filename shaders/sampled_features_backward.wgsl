// Adds the compactness gradients of sampled pixels, none of which occurs twice, to those of the image (twin:
// `FieldRefinement::add_compactness_gradient` in objective/src/field/mod.rs). A thread per pixel and vec4 of channels.
#import common

// x: first vec4 of the image's channels, y: channels, z: pixels sampled.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> pixels: array<u32>;
@group(0) @binding(2) var<storage, read> feature_grads: array<f32>;
// BLOCKS vec4 per pixel.
@group(0) @binding(3) var<storage, read_write> image: array<vec4f>;

@compute @workgroup_size(256)
fn sampled_features_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.z * BLOCKS {
        return;
    }
    let pixel = i % job.z;
    let block = i / job.z;
    var sum = vec4f(0.0);
    for (var l = 0u; l < 4u; l += 1u) {
        let channel = 4u * (job.x + block) + l;
        if channel < job.y {
            sum[l] = feature_grads[channel * job.z + pixel];
        }
    }
    image[pixels[pixel] * BLOCKS + block] += sum;
}
