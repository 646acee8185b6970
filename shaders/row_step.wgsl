// One step of the optimiser for rows with a gradient, by a part of their gradients (twin: `RowAdam::step` in
// objective/src/field/rows.rs). One thread per row.
#import common

// x: rows, y: vec4 of a row's part of the gradients, z: those of its part of the values (in the lower half) and where
// the gradients' first lies there, w: bits of the rate; the sign bit marks the first part.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> grads: array<vec4f>;
// Of `row_state`, of all parts.
@group(0) @binding(2) var<storage, read> states: array<u32>;
@group(0) @binding(3) var<storage, read_write> values: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> first: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> second: array<vec4f>;
// Steps of every row.
@group(0) @binding(6) var<storage, read_write> steps: array<u32>;

// By squaring: one less this is a small number, which a power by logarithms would spoil.
fn power(base: f32, exponent: u32) -> f32 {
    var result = 1.0;
    var square = base;
    for (var rest = exponent; rest > 0u; rest /= 2u) {
        if (rest & 1u) == 1u {
            result *= square;
        }
        square *= square;
    }
    return result;
}

@compute @workgroup_size(256)
fn row_step(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x || states[i] != 1u {
        return;
    }
    let step = steps[i] + (job.w >> 31u);
    steps[i] = step;
    let rate = bitcast<f32>(job.w & 0x7fffffffu);
    let bias1 = 1.0 / (1.0 - power(BETA1, step));
    let bias2 = 1.0 / (1.0 - power(BETA2, step));
    for (var k = 0u; k < job.y; k += 1u) {
        let at = i * (job.z & 0xffffu) + (job.z >> 16u) + k;
        let g = grads[i * job.y + k];
        let m = BETA1 * first[at] + (1.0 - BETA1) * g;
        let v = BETA2 * second[at] + (1.0 - BETA2) * g * g;
        first[at] = m;
        second[at] = v;
        values[at] -= rate * (m * bias1) / (sqrt(v * bias2) + ROOT);
    }
}
