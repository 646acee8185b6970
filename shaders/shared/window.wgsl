// The window of SSIM around the pixels of a tile (`WINDOW` in objective/src/losses.rs): from its middle outwards.
const REACH: u32 = 5u;
const WINDOW = array<f32, 6>(
    0.26601172, 0.21300553, 0.10936069, 0.03600077, 0.00759876, 0.00102838,
);
// A tile with the reach of its windows.
const WIDE: u32 = TILE + 2u * REACH;

// Where number `k` of a wide tile lies in the frame; it may lie outside.
fn position_of(tile: u32, k: u32, columns: u32) -> vec2i {
    let corner = vec2i(vec2u(tile % columns, tile / columns) * TILE) - i32(REACH);
    return corner + vec2i(vec2u(k % WIDE, k / WIDE));
}

fn inside(position: vec2i, frame: vec4u) -> bool {
    return all(position >= vec2i(0)) && all(position < vec2i(frame.xy));
}
