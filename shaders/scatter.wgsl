// Moves keys and items to where their digit puts them, keeping the order of equal digits: the last third of a pass of
// the radix sort. Thread t holds the four keys from 4t on of its block.
#import common

// x: keys, y: lowest bit of the digit, z: blocks.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> items: array<u32>;
// Running sums of `histogram`.
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> items_out: array<u32>;

// `[word][thread]`: how often each digit occurs up to a thread, two digits to a word; none is above 1024.
var<workgroup> counters: array<u32, 2048>;

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let block = group_of(id, groups);
    let first = block * 1024u + local * 4u;
    var key: array<u32, 4>;
    var rank: array<u32, 4>;
    for (var word = 0u; word < 8u; word += 1u) {
        counters[word * 256u + local] = 0u;
    }
    for (var k = 0u; k < 4u; k += 1u) {
        if first + k < job.x {
            key[k] = keys[first + k];
            let digit = (key[k] >> job.y) & 15u;
            let at = (digit / 2u) * 256u + local;
            let shift = (digit & 1u) * 16u;
            rank[k] = (counters[at] >> shift) & 0xffffu;
            counters[at] += 1u << shift;
        }
    }
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        var left: array<u32, 8>;
        if local >= step {
            for (var word = 0u; word < 8u; word += 1u) {
                left[word] = counters[word * 256u + local - step];
            }
        }
        workgroupBarrier();
        for (var word = 0u; word < 8u; word += 1u) {
            counters[word * 256u + local] += left[word];
        }
        workgroupBarrier();
    }
    for (var k = 0u; k < 4u; k += 1u) {
        if first + k < job.x {
            let digit = (key[k] >> job.y) & 15u;
            var before = 0u;
            if local > 0u {
                before = (counters[(digit / 2u) * 256u + local - 1u] >> ((digit & 1u) * 16u)) & 0xffffu;
            }
            let to = starts[digit * job.z + block] + before + rank[k];
            keys_out[to] = key[k];
            items_out[to] = items[first + k];
        }
    }
}
