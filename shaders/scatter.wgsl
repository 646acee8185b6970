// Moves keys and items to the position of their digit, keeping the order of equal digits: the last third of a pass of
// the radix sort. The thread of position p holds the four keys from 4p on of its block.
#import common
#import running

// How often each digit occurs, two digits to a word; none is above 1024.
alias Counted = vec4u;
const PARTS: u32 = 2u;

// x: keys, y: lowest bit of the digit, z: blocks.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> items: array<u32>;
// Running sums of `histogram`.
@group(0) @binding(3) var<storage, read> starts: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> items_out: array<u32>;

// Which of the words holds a digit: all its bits, and none of the others. An index would keep the words out of registers.
fn word_of(digit: u32, part: u32) -> Counted {
    let word = vec4u(digit / 2u);
    let words = vec4u(0u, 1u, 2u, 3u) + 4u * part;
    return select(vec4u(0u), vec4u(0xffffffffu), word == words);
}

fn shift_of(digit: u32) -> u32 {
    return (digit & 1u) * 16u;
}

fn count_of(digit: u32, counts: array<Counted, PARTS>) -> u32 {
    let words = (counts[0] & word_of(digit, 0u)) | (counts[1] & word_of(digit, 1u));
    return ((words.x | words.y | words.z | words.w) >> shift_of(digit)) & 0xffffu;
}

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let block = group_of(id, groups);
    let position = position_in_group(local);
    let first = block * 1024u + position.number * 4u;
    var key: array<u32, 4>;
    var rank: array<u32, 4>;
    var counts: array<Counted, PARTS>;
    for (var k = 0u; k < 4u; k += 1u) {
        if first + k < job.x {
            key[k] = keys[first + k];
            let digit = (key[k] >> job.y) & 15u;
            rank[k] = count_of(digit, counts);
            let one = Counted(1u << shift_of(digit));
            counts[0] += word_of(digit, 0u) & one;
            counts[1] += word_of(digit, 1u) & one;
        }
    }
    let before = sum_before(position, counts);
    for (var k = 0u; k < 4u; k += 1u) {
        if first + k < job.x {
            let digit = (key[k] >> job.y) & 15u;
            let to = starts[digit * job.z + block] + count_of(digit, before) + rank[k];
            keys_out[to] = key[k];
            items_out[to] = items[first + k];
        }
    }
}
