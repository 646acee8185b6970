// How often each digit occurs among the keys of a block: the first third of a pass of the radix sort (twin:
// `sort_by_key` in raster/src/cpu/bin.rs). A workgroup counts a block of 1024 keys.
#import common

// x: keys, y: lowest bit of the digit, z: blocks.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
// `[digit][block]`, so that its running sum is where each block's keys of a digit go.
@group(0) @binding(2) var<storage, read_write> counts: array<u32>;

var<workgroup> count: array<atomic<u32>, 16>;

@compute @workgroup_size(256)
fn histogram(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let block = group_of(id, groups);
    if local < 16u {
        atomicStore(&count[local], 0u);
    }
    workgroupBarrier();
    for (var k = 0u; k < 4u; k += 1u) {
        let i = block * 1024u + k * 256u + local;
        if i < job.x {
            atomicAdd(&count[(keys[i] >> job.y) & 15u], 1u);
        }
    }
    workgroupBarrier();
    if local < 16u && block < job.z {
        counts[local * job.z + block] = atomicLoad(&count[local]);
    }
}
