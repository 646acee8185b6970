// A map from another, or from the sum of two (twins: `Map::add`, `Map::concat` and `Map::split` in nn/src/map.rs). One
// thread per number.
#import common
#import layer

// x: layer, y: numbers.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> layers: array<Layer>;
@group(0) @binding(2) var<storage, read_write> maps: array<f32>;

@compute @workgroup_size(256)
fn add_maps(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let layer = layers[job.x];
    let k = group_of(id, groups) * 256u + local;
    if k >= job.y {
        return;
    }
    var made = maps[layer.reads + k];
    if layer.other != NOWHERE {
        made += maps[layer.other + k];
    }
    if is_set(layer, ADD) {
        made += maps[layer.writes + k];
    }
    maps[layer.writes + k] = select(made, max(made, 0.0), is_set(layer, RELU));
}
