// Adds to every number what came before its block: the second half of a running sum (`scan.wgsl`).
#import common

// x: numbers.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read_write> data: array<u32>;
@group(0) @binding(2) var<storage, read> sums: array<u32>;

@compute @workgroup_size(256)
fn scan_add(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i < job.x {
        let sum = data[i] + sums[i / 1024u];
        data[i] = select(sum, 0xffffffffu, sum < data[i]);
    }
}
