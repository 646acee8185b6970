// For each of a group's 256 threads the sum over the threads before it, of PARTS numbers of the kernel's type
// `Counted`. They are whole numbers, so that no order changes the sums. All threads call it. `running_subgroups.wgsl`
// is the same for devices that have subgroups.
var<workgroup> counted: array<Counted, 256 * PARTS>;

// A thread's position in the order of summation: `number` of 256.
struct Position {
    number: u32,
}

fn position_in_group(local: u32) -> Position {
    return Position(local);
}

fn sum_before(position: Position, mine: array<Counted, PARTS>) -> array<Counted, PARTS> {
    var sums = mine;
    for (var p = 0u; p < PARTS; p += 1u) {
        counted[p * 256u + position.number] = sums[p];
    }
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        if position.number >= step {
            for (var p = 0u; p < PARTS; p += 1u) {
                sums[p] += counted[p * 256u + position.number - step];
            }
        }
        workgroupBarrier();
        for (var p = 0u; p < PARTS; p += 1u) {
            counted[p * 256u + position.number] = sums[p];
        }
        workgroupBarrier();
    }
    for (var p = 0u; p < PARTS; p += 1u) {
        sums[p] -= mine[p];
    }
    return sums;
}
