// A layer of a network, forward or backward, as the host lays it out (`LayerUniform` in
// services/gpu/src/nets/layer.rs). Maps lie plane after plane; a plane of splats has the capacity of a piece. The flags
// are the host's own.
struct Layer {
    // Where its input and its output start.
    reads: u32,
    writes: u32,
    // Its weights, and its offsets or NOWHERE.
    weights: u32,
    offsets: u32,
    // Planes.
    input: u32,
    output: u32,
    // Side of the kernel, and how far it reaches up and to the left.
    kernel: u32,
    border: u32,
    // Of input and output; of quarters, those of the whole plane.
    in_width: u32,
    in_height: u32,
    out_width: u32,
    out_height: u32,
    // Pixels read per pixel written, and pixels between those that are read, with zeros between them.
    step: u32,
    gap: u32,
    // Weights from one output, and from one input, to the next.
    by_output: u32,
    by_input: u32,
    // Another map that takes part.
    other: u32,
    flags: u32,
    unused_a: u32,
    unused_b: u32,
}

fn is_set(layer: Layer, flag: u32) -> bool {
    return (layer.flags & flag) != 0u;
}

// Number of columns: pixels, or splats of the piece that starts with the splat `first` of those in sight.
fn columns_of(layer: Layer, first: u32, in_sight: u32) -> u32 {
    let capacity = layer.out_width * layer.out_height;
    return select(capacity, min(capacity, in_sight - min(in_sight, first)), is_set(layer, COUNTED));
}

// The output pixel of a column.
fn pixel_of(layer: Layer, column: u32) -> vec2u {
    return vec2u(column % layer.out_width, column / layer.out_width);
}

// The pixel after this one.
fn after(layer: Layer, pixel: vec2u) -> vec2u {
    return select(vec2u(0u, pixel.y + 1u), vec2u(pixel.x + 1u, pixel.y), pixel.x + 1u < layer.out_width);
}

// Where the quarter `plane % 4` of a plane has its pixel.
fn quarter(plane: u32, pixel: vec2u, width: u32, height: u32) -> u32 {
    let row = 2u * pixel.y + (plane % 4u) / 2u;
    return (plane / 4u) * 4u * width * height + row * 2u * width + 2u * pixel.x + plane % 2u;
}

// Where one of the planes that are written has its pixel.
fn written(layer: Layer, plane: u32, column: u32, pixel: vec2u) -> u32 {
    if is_set(layer, WRITE_QUARTERS) {
        return layer.writes + quarter(plane, pixel, layer.out_width, layer.out_height);
    }
    return layer.writes + plane * layer.out_width * layer.out_height + column;
}

// An input, and how far its tap lies from the first one.
struct Tap {
    input: u32,
    by: vec2u,
}

// The tap that a weight of an output is for.
fn tap_of(layer: Layer, weight: u32) -> Tap {
    let taps = layer.kernel * layer.kernel;
    let tap = weight % taps;
    return Tap(weight / taps, vec2u(tap % layer.kernel, tap / layer.kernel));
}

// Position of the input of a tap at an output pixel; NOWHERE beyond the border, and between pixels.
fn tapped(layer: Layer, tap: Tap, pixel: vec2u) -> u32 {
    if is_set(layer, READ_QUARTERS) {
        return layer.reads + quarter(tap.input, pixel, layer.in_width, layer.in_height);
    }
    // A coordinate below 0 wraps to a huge one, and so is beyond the last.
    var seen = pixel * layer.step + tap.by - layer.border;
    // Dividing is slow, and most layers have no fractional stride.
    if layer.gap > 1u {
        if any(seen % layer.gap != vec2u(0u)) {
            return NOWHERE;
        }
        seen /= layer.gap;
    }
    if seen.x >= layer.in_width || seen.y >= layer.in_height {
        return NOWHERE;
    }
    return layer.reads + (tap.input * layer.in_height + seen.y) * layer.in_width + seen.x;
}
