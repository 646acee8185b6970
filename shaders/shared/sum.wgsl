// The sum over a group's threads of values of the kernel's type `Summed`. All threads call it.
var<workgroup> part: array<Summed, 256>;

fn sum_of_group(local: u32, mine: Summed) -> Summed {
    part[local] = mine;
    workgroupBarrier();
    for (var half = 128u; half > 0u; half /= 2u) {
        if local < half {
            part[local] += part[local + half];
        }
        workgroupBarrier();
    }
    let sum = part[0];
    // Before the array is written again.
    workgroupBarrier();
    return sum;
}
