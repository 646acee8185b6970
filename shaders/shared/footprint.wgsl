// A splat projected on the image (twin: `SplatFootprint` in raster/src/cpu/project.rs): log2 alpha = lo - a u² - e dy²,
// with u = dx - slope dy. Stored as two vec4.
struct Footprint {
    x: f32,
    y: f32,
    slope: f32,
    a: f32,
    e: f32,
    lo: f32,
    inv_a: f32,
    reach: f32,
}

fn footprint(p: vec4f, q: vec4f) -> Footprint {
    return Footprint(p.x, p.y, p.z, p.w, q.x, q.y, q.z, q.w);
}

// A splat at one pixel: `raw` is its opacity there before it is held at ALPHA_MAX.
struct Touch {
    u: f32,
    dy: f32,
    raw: f32,
}

fn touch(f: Footprint, pixel: vec2f) -> Touch {
    let dy = pixel.y - f.y;
    let u = (pixel.x - f.x) - f.slope * dy;
    let power = (f.lo - f.e * (dy * dy)) - f.a * (u * u);
    return Touch(u, dy, exp2(max(power, -64.0)));
}

// Centre of a tile's pixel.
fn pixel_of(tile: u32, local: u32, columns: u32) -> vec2u {
    return vec2u((tile % columns) * TILE + local % TILE, (tile / columns) * TILE + local / TILE);
}
