// Running sums inside blocks of 1024 numbers, each without the number itself, and the sum of every block. A sum that
// overflows stays at the largest number, so that the host sees it. A thread holds four consecutive numbers.
#import common
#import running

// Lower and upper half of a number: 256 such sums fit, whatever they are of.
alias Counted = vec2u;
const PARTS: u32 = 1u;

// x: numbers.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read_write> data: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;

fn plus(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}

fn joined(halves: Counted) -> u32 {
    let upper = halves.y + (halves.x >> 16u);
    return select((upper << 16u) | (halves.x & 0xffffu), 0xffffffffu, upper > 0xffffu);
}

@compute @workgroup_size(256)
fn scan(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let block = group_of(id, groups);
    let position = position_in_group(local);
    let first = block * 1024u + position.number * 4u;
    var held: array<u32, 4>;
    var sum = 0u;
    for (var k = 0u; k < 4u; k += 1u) {
        held[k] = sum;
        if first + k < job.x {
            sum = plus(sum, data[first + k]);
        }
    }
    let halves = array<Counted, PARTS>(Counted(sum & 0xffffu, sum >> 16u));
    let before = joined(sum_before(position, halves)[0]);
    for (var k = 0u; k < 4u; k += 1u) {
        if first + k < job.x {
            data[first + k] = plus(before, held[k]);
        }
    }
    if position.number == 255u && block * 1024u < job.x {
        sums[block] = plus(before, sum);
    }
}
