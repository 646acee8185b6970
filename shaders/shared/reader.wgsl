// Inputs for sampling the light of a photo (`run` in objective/src/appearance/gsw/points.rs), as the host lays them out
// (`ReaderUniform` in services/gpu/src/nets/points.rs). SAMPLE, MAPS, INTRINSIC, EMBEDDING_SIZE, COORDINATE, DROPPED and OFF_MAP
// are constants of the appearance model `gsw`.
struct Reader {
    // The photo's camera: world to camera, row by row; focal lengths and principal point; width and height, the near
    // plane, the penalty of a coordinate outside the map.
    pose: array<vec4f, 3>,
    lens: vec4f,
    frame: vec4f,
    // Centre of the camera.
    eye: vec4f,
    // Width and height of the maps, where they start, 1 if there is light.
    map: vec4u,
    // Splats of a piece; where the inputs of the networks for light, vectors and colours start.
    capacity: vec4u,
    // Where the shares of the spots start, planes of the dynamic feature before the intrinsic one, octaves, the step's
    // random number.
    more: vec4u,
}

// Numbers of the dynamic feature.
const DYNAMIC: u32 = SAMPLE * (MAPS + 1u);

// A point on a map: the pixel up and to the left, shares of the way to the next, and pixels per unit of the coordinate.
struct Spot {
    there: bool,
    pixel: vec2u,
    share: vec2f,
    slope: vec2f,
}

// Twin: `BilinearSample::new` in nn/src/sample.rs.
fn spot_at(reader: Reader, at: vec2f) -> Spot {
    let most = vec2f(reader.map.xy - 1u);
    // NaN is taken as the middle.
    let v = vec2f(select(0.0, at.x, at.x == at.x), select(0.0, at.y, at.y == at.y));
    let p = (v + 1.0) * 0.5 * most;
    let held = clamp(p, vec2f(0.0), most);
    let pixel = min(vec2u(held), reader.map.xy - 2u);
    return Spot(true, pixel, held - vec2f(pixel), select(vec2f(0.0), 0.5 * most, p == held));
}

// Projects a splat into the photo (twins: `ImageConditioning::pixel_of` in
// objective/src/appearance/gsw/image_conditioning.rs, `spots` in points.rs there).
fn spot_of(reader: Reader, mean: vec3f) -> Spot {
    let at = vec4f(mean, 1.0);
    let p = vec3f(dot(reader.pose[0], at), dot(reader.pose[1], at), dot(reader.pose[2], at));
    let nowhere = Spot(false, vec2u(0u), vec2f(0.0), vec2f(0.0));
    if !finite3(p) || p.z <= reader.frame.z {
        return nowhere;
    }
    let share = (reader.lens.xy * p.xy / p.z + reader.lens.zw) / reader.frame.xy;
    if !(all(share >= vec2f(0.0)) && all(share < vec2f(1.0))) {
        return nowhere;
    }
    let size = vec2f(reader.map.xy);
    return spot_at(reader, 2.0 * (share * size - 0.5) / (size - 1.0) - 1.0);
}

fn mixed(x: u32) -> u32 {
    var y = (x ^ (x >> 16u)) * 0x7feb352du;
    y = (y ^ (y >> 15u)) * 0x846ca68bu;
    return y ^ (y >> 16u);
}

// Dropout factor of a number of a splat's dynamic feature (twin: `is_dropped` in points.rs).
fn kept(reader: Reader, splat: u32, number: u32) -> f32 {
    let word = mixed(mixed(mixed(reader.more.w) ^ splat) ^ number);
    return select(1.0 / (1.0 - DROPPED), 0.0, f32(word >> 8u) * (1.0 / 16777216.0) < DROPPED);
}
