// A layer of a network on its way forward or back, as the host lays it out (`Layer` in services/gpu/src/nets/plan.rs). Maps
// lie plane after plane; of splats, each plane has room for a piece of them. The flags are the host's own.
struct Layer {
    // Where what it reads and what it writes begins.
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
    // Of what it reads and writes; of quarters, those of what they are quarters of.
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

// Columns that there are: pixels, or splats of the piece that begins with the splat `first` of those in sight.
fn columns_of(layer: Layer, first: u32, in_sight: u32) -> u32 {
    let room = layer.out_width * layer.out_height;
    return select(room, min(room, in_sight - min(in_sight, first)), is_set(layer, COUNTED));
}

// Where the quarter `plane % 4` of a plane has its pixel.
fn quarter(plane: u32, column: u32, width: u32, height: u32) -> u32 {
    let row = 2u * (column / width) + (plane % 4u) / 2u;
    return (plane / 4u) * 4u * width * height + row * 2u * width + 2u * (column % width) + plane % 2u;
}

// Where the number lies that a tap of an input sees at a column; NOWHERE beyond the border, and between pixels.
fn tapped(layer: Layer, input: u32, tap: u32, column: u32) -> u32 {
    if is_set(layer, PLAIN) {
        return layer.reads + input * layer.in_width * layer.in_height + column;
    }
    if is_set(layer, READ_QUARTERS) {
        return layer.reads + quarter(input, column, layer.in_width, layer.in_height);
    }
    let at = vec2i(vec2u(column % layer.out_width, column / layer.out_width) * layer.step);
    let seen = at + vec2i(vec2u(tap % layer.kernel, tap / layer.kernel)) - i32(layer.border);
    if seen.x < 0 || seen.y < 0 {
        return NOWHERE;
    }
    let pixel = vec2u(seen) / layer.gap;
    if any(vec2u(seen) % layer.gap != vec2u(0u)) || pixel.x >= layer.in_width || pixel.y >= layer.in_height {
        return NOWHERE;
    }
    return layer.reads + (input * layer.in_height + pixel.y) * layer.in_width + pixel.x;
}
