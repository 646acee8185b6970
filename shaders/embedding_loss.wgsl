// The embedding loss and its gradient (twin: `embedding_loss` in objective/src/field/embedding.rs). A thread per number of the
// planes.
#import common
#import sum

alias Summed = f32;

// x: where the rendered planes start in the maps, y: numbers, z: cells of a plane, w: bits of the weight of a number.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> maps: array<f32>;
// Plane after plane.
@group(0) @binding(2) var<storage, read> wanted: array<f32>;
// Validity of each cell.
@group(0) @binding(3) var<storage, read> trust: array<f32>;
// Laid out as the maps.
@group(0) @binding(4) var<storage, read_write> grads: array<f32>;
// Partial sum of each group.
@group(0) @binding(5) var<storage, read_write> parts: array<f32>;

@compute @workgroup_size(256)
fn embedding_loss(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let i = group * 256u + local;
    var loss = 0.0;
    if i < job.y {
        let off = maps[job.x + i] - wanted[i];
        let trusted = trust[i % job.z];
        let sign = select(0.0, 1.0, off > 0.0) - select(0.0, 1.0, off < 0.0);
        grads[job.x + i] = trusted * bitcast<f32>(job.w) * sign;
        loss = trusted * abs(off);
    }
    let all = sum_of_group(local, loss);
    if local == 0u && group * 256u < job.y {
        parts[group] = all;
    }
}
