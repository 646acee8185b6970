// The variant of `running.wgsl` with subgroups: two barriers instead of seventeen. Nothing is assumed of subgroups:
// neither how many threads each has, nor that all have as many, nor which. So threads get new positions, consecutive
// within a subgroup. Which subgroup comes first may differ from run to run; sums of whole numbers do not.
var<workgroup> counted: array<Counted, 256 * PARTS>;
// Subgroups that have their positions, in the upper half, and threads.
var<workgroup> taken: atomic<u32>;

// A thread's position in the order of summation: `number` of 256, in the subgroup of this `rank`, whose last it may be.
struct Position {
    number: u32,
    rank: u32,
    is_last: bool,
}

fn position_in_group(local: u32) -> Position {
    if local == 0u {
        atomicStore(&taken, 0u);
    }
    workgroupBarrier();
    let lane = subgroupExclusiveAdd(1u);
    let lanes = subgroupAdd(1u);
    var first = 0u;
    if lane == 0u {
        first = atomicAdd(&taken, (1u << 16u) + lanes);
    }
    first = subgroupBroadcastFirst(first);
    return Position((first & 0xffffu) + lane, first >> 16u, lane + 1u == lanes);
}

fn sum_before(position: Position, mine: array<Counted, PARTS>) -> array<Counted, PARTS> {
    var sums: array<Counted, PARTS>;
    for (var p = 0u; p < PARTS; p += 1u) {
        sums[p] = subgroupExclusiveAdd(mine[p]);
        if position.is_last {
            counted[position.rank * PARTS + p] = sums[p] + mine[p];
        }
    }
    workgroupBarrier();
    for (var s = 0u; s < position.rank; s += 1u) {
        for (var p = 0u; p < PARTS; p += 1u) {
            sums[p] += counted[s * PARTS + p];
        }
    }
    return sums;
}
