// Averages of a view's pixels over the cells of the embedding's grid (twin: `AreaAverage::forward` in objective/src/field/area.rs).
// A thread per cell and vec4 of channels.
#import common
#import cells

// x: first vec4 of the image's channels, y: channels.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> cells: array<u32>;
// BLOCKS vec4 per pixel.
@group(0) @binding(2) var<storage, read> image: array<vec4f>;
// Plane after plane.
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;

@compute @workgroup_size(256)
fn area_average(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    let all = cells[2] * cells[3];
    if i >= all * BLOCKS {
        return;
    }
    let cell = i % all;
    let block = i / all;
    let column = window_of(cells[4], cell % cells[2]);
    let row = window_of(cells[5], cell / cells[2]);
    var sum = vec4f(0.0);
    for (var x = column.start; x < column.start + column.count; x += 1u) {
        var down = vec4f(0.0);
        for (var y = row.start; y < row.start + row.count; y += 1u) {
            down += share_of(row, y) * image[(y * cells[0] + x) * BLOCKS + block];
        }
        sum += share_of(column, x) * down;
    }
    for (var l = 0u; l < 4u; l += 1u) {
        let channel = 4u * (job.x + block) + l;
        if channel < job.y {
            maps[channel * all + cell] = sum[l];
        }
    }
}
