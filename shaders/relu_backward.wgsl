// The backward pass of a ReLU: values that it cut have no gradient (twin: `Map::relu_backward` in nn/src/map.rs). One
// thread per number.
#import common

// x: where the map starts, y: numbers.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> maps: array<f32>;
// Laid out as the maps.
@group(0) @binding(2) var<storage, read_write> grads: array<f32>;

@compute @workgroup_size(256)
fn relu_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    if k < job.y {
        let at = job.x + k;
        grads[at] = select(0.0, grads[at], maps[at] > 0.0);
    }
}
