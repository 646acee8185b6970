// The sum over a group's threads; all of them call it.
var<workgroup> part: array<f32, 256>;

fn sum_of_group(local: u32, mine: f32) -> f32 {
    part[local] = mine;
    workgroupBarrier();
    for (var half = 128u; half > 0u; half /= 2u) {
        if local < half {
            part[local] += part[local + half];
        }
        workgroupBarrier();
    }
    let sum = part[0];
    // Before anything else is put there.
    workgroupBarrier();
    return sum;
}
