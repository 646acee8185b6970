// Shared by all kernels: sizes, the number of a workgroup, and a test for numbers that are not finite. The cut-offs
// (ALPHA_MIN, ALPHA_MAX, T_MIN, LOG2_ALPHA_MIN, SLACK) are the CPU engine's own: the host writes them above this file,
// and BLOCKS too: how many vec4 of channels a kernel carries at once.

// Width and height of a tile, and its pixels.
const TILE: u32 = 16u;
const PIXELS: u32 = 256u;
// Splats of one tile that one workgroup of `gather` and `backward` carries.
const BUCKET: u32 = 64u;
// q / 2 in units of base-2 logarithms.
const HALF_LOG2_E: f32 = 0.72134752;

// Workgroups are laid out in rows, because one dimension holds at most 65535 of them.
fn group_of(id: vec3u, groups: vec3u) -> u32 {
    return id.y * groups.x + id.x;
}

// By the bits: a compiler may assume that no number is infinite or NaN.
fn finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn finite3(v: vec3f) -> bool {
    return finite(v.x) && finite(v.y) && finite(v.z);
}

fn finite4(v: vec4f) -> bool {
    return finite(v.x) && finite(v.y) && finite(v.z) && finite(v.w);
}
