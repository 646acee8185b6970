// Running sums inside blocks of 1024 numbers, each without the number itself, and the sum of every block. A sum that
// does not fit stays at the largest number, so that the host sees it.
#import common

// x: numbers.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read_write> data: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;

var<workgroup> partial: array<u32, 256>;

fn plus(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}

@compute @workgroup_size(256)
fn scan(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let block = group_of(id, groups);
    let first = block * 1024u + local * 4u;
    var held: array<u32, 4>;
    var sum = 0u;
    for (var k = 0u; k < 4u; k += 1u) {
        held[k] = sum;
        if first + k < job.x {
            sum = plus(sum, data[first + k]);
        }
    }
    partial[local] = sum;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        var left = 0u;
        if local >= step {
            left = partial[local - step];
        }
        workgroupBarrier();
        partial[local] = plus(left, partial[local]);
        workgroupBarrier();
    }
    var before = 0u;
    if local > 0u {
        before = partial[local - 1u];
    }
    for (var k = 0u; k < 4u; k += 1u) {
        if first + k < job.x {
            data[first + k] = plus(before, held[k]);
        }
    }
    if local == 255u && block * 1024u < job.x {
        sums[block] = partial[255];
    }
}
