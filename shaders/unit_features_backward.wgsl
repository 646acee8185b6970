// Gradients of a piece's features from those of its unit features (twin: `compactness` in objective/src/field/compact.rs).
// A thread per pixel of the piece.
#import common
#import layer

// x: pixels, y: channels, z: layer that computed the piece's cosines; the next is its backward pass.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
// Of `unit_features`.
@group(0) @binding(2) var<storage, read> features: array<f32>;
@group(0) @binding(3) var<storage, read> lengths: array<f32>;
// Gradients of the piece's unit features, plane by plane.
@group(0) @binding(4) var<storage, read> grads: array<f32>;
// Gradients of all pixels' features, plane by plane.
@group(0) @binding(5) var<storage, read_write> feature_grads: array<f32>;

@compute @workgroup_size(256)
fn unit_features_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let piece = layers[job.z];
    let made = layers[job.z + 1u].writes;
    let k = group_of(id, groups) * 256u + local;
    if k >= piece.out_width {
        return;
    }
    let pixel = piece.reads + k;
    let length = lengths[pixel];
    var along = 0.0;
    for (var c = 0u; c < job.y; c += 1u) {
        along += features[c * job.x + pixel] * grads[made + c * piece.out_width + k];
    }
    for (var c = 0u; c < job.y; c += 1u) {
        var feature_grad = 0.0;
        if length > 0.0 {
            // Each pair was counted from one end.
            let grad = grads[made + c * piece.out_width + k];
            feature_grad = 2.0 * (grad - along * features[c * job.x + pixel]) / length;
        }
        feature_grads[c * job.x + pixel] = feature_grad;
    }
}
