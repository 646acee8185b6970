// Unit features of sampled pixels; 0 for those that take no part: in no mask, or of length 0 (twin: `compactness` in
// objective/src/field/compact.rs). A thread per pixel.
#import common

// x: pixels, y: channels.
@group(0) @binding(0) var<uniform> job: vec4u;
// The set of masks that hold each, or NO_MASK.
@group(0) @binding(1) var<storage, read> groups_of: array<u32>;
// Plane after plane: features, which become unit features.
@group(0) @binding(2) var<storage, read_write> features: array<f32>;
// A copy, at the first of the maps of the product.
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;
// 0 for those that take no part.
@group(0) @binding(4) var<storage, read_write> lengths: array<f32>;

@compute @workgroup_size(256)
fn unit_features(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    var squares = 0.0;
    for (var k = 0u; k < job.y; k += 1u) {
        let v = features[k * job.x + i];
        squares += v * v;
    }
    var length = sqrt(squares);
    if groups_of[i] == NO_MASK || !finite(squares) || !(length > SHORTEST) {
        length = 0.0;
    }
    lengths[i] = length;
    for (var k = 0u; k < job.y; k += 1u) {
        var unit = 0.0;
        if length > 0.0 {
            unit = features[k * job.x + i] / length;
        }
        features[k * job.x + i] = unit;
        maps[k * job.x + i] = unit;
    }
}
