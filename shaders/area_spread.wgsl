// The backward pass of `area_average`, weighted: the gradients of a view's pixels (twin: `AreaAverage::transposed` in
// objective/src/field/area.rs). A thread per pixel and vec4 of channels.
#import common
#import cells

// x: first vec4 of the image's channels, y: channels, z: bits of the weight.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> cells: array<u32>;
// Plane after plane.
@group(0) @binding(2) var<storage, read> grads: array<f32>;
// BLOCKS vec4 per pixel.
@group(0) @binding(3) var<storage, read_write> image: array<vec4f>;

@compute @workgroup_size(256)
fn area_spread(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= cells[0] * cells[1] * BLOCKS {
        return;
    }
    let pixel = i / BLOCKS;
    let block = i % BLOCKS;
    let at = vec2u(pixel % cells[0], pixel / cells[0]);
    let all = cells[2] * cells[3];
    // Cells that the pixel is part of.
    let across = cells[6] + 2u * at.x;
    let down = cells[7] + 2u * at.y;
    var sum = vec4f(0.0);
    for (var y = cells[down]; y < cells[down] + cells[down + 1u]; y += 1u) {
        var line = vec4f(0.0);
        for (var x = cells[across]; x < cells[across] + cells[across + 1u]; x += 1u) {
            let weight = share_of(window_of(cells[4], x), at.x);
            for (var l = 0u; l < 4u; l += 1u) {
                let channel = 4u * (job.x + block) + l;
                if channel < job.y {
                    line[l] += weight * grads[channel * all + y * cells[2] + x];
                }
            }
        }
        sum += share_of(window_of(cells[5], y), at.y) * line;
    }
    image[i] = bitcast<f32>(job.z) * sum;
}
