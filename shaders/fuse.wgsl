// The cosines of every row to some queries as one number, each weighted by how large it is (twin: `fuse` in
// objective/src/field/similarity.rs; paper Eq. 27). A thread per row.
#import common

// x: rows, y: queries, z: bits of one over the temperature.
@group(0) @binding(0) var<uniform> job: vec4u;
// Of `cosines`.
@group(0) @binding(1) var<storage, read> sums: array<f32>;
@group(0) @binding(2) var<storage, read_write> fused: array<f32>;

@compute @workgroup_size(256)
fn fuse(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    let first = i * (job.y + 1u);
    let squares = sums[first + job.y];
    let norm = 1.0 / sqrt(squares);
    // A row of length 0, or with NaN, has similarity 0.
    if !finite(squares) || !(squares > 0.0) || !finite(norm) {
        fused[i] = 0.0;
        return;
    }
    var top = -1.0;
    for (var q = 0u; q < job.y; q += 1u) {
        top = max(top, clamp(sums[first + q] * norm, -1.0, 1.0));
    }
    var sum = 0.0;
    var weight = 0.0;
    for (var q = 0u; q < job.y; q += 1u) {
        let cosine = clamp(sums[first + q] * norm, -1.0, 1.0);
        let w = exp(max((cosine - top) * bitcast<f32>(job.z), -80.0));
        weight += w;
        sum += w * cosine;
    }
    fused[i] = sum / weight;
}
