// Which tiles hold a pixel centre of the ellipse where alpha reaches 1/255 (twin: `cover` in raster/src/cpu/bin.rs).

// dy of the ellipse's rightmost point.
fn tip_of(f: Footprint) -> f32 {
    let syy = HALF_LOG2_E / f.e;
    let sxy = f.slope * syy;
    let sxx = HALF_LOG2_E * f.inv_a + f.slope * sxy;
    let q = max((f.lo - LOG2_ALPHA_MIN) / HALF_LOG2_E, 0.0);
    return sxy / sxx * (sqrt(q * sxx) + SLACK);
}

// First and last row of pixels; the first is above the last where there is none.
fn rows_of(f: Footprint, height: u32) -> vec2f {
    let top = max(ceil(f.y - f.reach - 0.5), 0.0);
    let low = min(floor(f.y + f.reach - 0.5), f32(height) - 1.0);
    return vec2f(top, low);
}

fn half_width(f: Footprint, dy: f32) -> f32 {
    return sqrt(max((f.lo - LOG2_ALPHA_MIN - f.e * dy * dy) * f.inv_a, 0.0)) + SLACK;
}

// First tile in a row of tiles, and the one after the last.
fn columns_of(f: Footprint, tip: f32, rows: vec2f, row: u32, width: u32) -> vec2u {
    // The band cuts a convex shape, so each side's farthest point is the shape's own, or lies on the nearer edge
    // of the band.
    let first = max(max(f32(row * TILE), rows.x) + 0.5 - f.y, -f.reach);
    let last = min(min(f32(row * TILE + TILE - 1u), rows.y) + 0.5 - f.y, f.reach);
    let dl = min(max(-tip, first), last);
    let dr = min(max(tip, first), last);
    let left = max(ceil(f.x + f.slope * dl - half_width(f, dl) - 0.5), 0.0);
    let right = min(floor(f.x + f.slope * dr + half_width(f, dr) - 0.5), f32(width) - 1.0);
    if left > right {
        return vec2u(0u, 0u);
    }
    return vec2u(u32(left) / TILE, u32(right) / TILE + 1u);
}
