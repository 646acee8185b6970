// Adds the partial sums of slices to the gradients of a layer's weights (twin: `Conv::kernel_gradient` in
// nn/src/conv.rs). One thread per weight.
#import common
#import layer

// x: layer, y: slices.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
// Of `convolve_weights`.
@group(0) @binding(2) var<storage, read> parts: array<f32>;
@group(0) @binding(3) var<storage, read_write> weight_grads: array<f32>;

@compute @workgroup_size(256)
fn sum_weights(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let n = group_of(id, groups) * 256u + local;
    let taps = layer.kernel * layer.kernel;
    let wide = layer.input * taps + 1u;
    if n >= layer.output * wide {
        return;
    }
    let plane = n / wide;
    let k = n % wide;
    let is_offset = k + 1u == wide;
    // The quarters of a plane have one offset.
    let shared_by = select(1u, 4u, is_offset && is_set(layer, WRITE_QUARTERS));
    if plane % shared_by != 0u {
        return;
    }
    var sum = 0.0;
    for (var slice = 0u; slice < job.y; slice += 1u) {
        for (var q = 0u; q < shared_by; q += 1u) {
            sum += parts[(slice * layer.output + plane + q) * wide + k];
        }
    }
    var to = layer.offsets + plane / shared_by;
    if !is_offset {
        to = layer.weights + plane * layer.by_output + (k / taps) * layer.by_input + k % taps;
    }
    weight_grads[to] += sum;
}
