// Sums over the partial sums of groups. A group per sum.
#import common
#import sum

alias Summed = f32;

// x: groups, y: sums of each, z: where the totals go.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> parts: array<f32>;
@group(0) @binding(2) var<storage, read_write> results: array<f32>;

@compute @workgroup_size(256)
fn sum_groups(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let column = group_of(id, groups);
    var sum = 0.0;
    for (var k = local; k < job.x; k += 256u) {
        sum += parts[k * job.y + column];
    }
    let all = sum_of_group(local, sum);
    if local == 0u && column < job.y {
        results[job.z + column] = all;
    }
}
