// Measures the rate of multiply-adds: eight independent chains per thread. The floors of other kernels' operations use
// it.
#import common

// x: threads, y: turns; each is 8 multiply-adds, 16 operations.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read_write> out: array<f32>;

@compute @workgroup_size(256)
fn multiply_add(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    let start = f32(i & 255u) / 256.0;
    var a = vec4f(start, start + 0.1, start + 0.2, start + 0.3);
    var b = a + 0.4;
    for (var k = 0u; k < job.y; k += 1u) {
        a = fma(a, vec4f(0.999), vec4f(0.001));
        b = fma(b, vec4f(0.998), vec4f(0.002));
    }
    let sum = a + b;
    out[i] = sum.x + sum.y + sum.z + sum.w;
}
