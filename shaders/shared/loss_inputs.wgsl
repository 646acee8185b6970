// Inputs of the losses of a photo (`LossInputs` in objective/src/compare.rs), as the host lays them out (`LossUniform`
// in services/gpu/src/compare.rs).
struct LossInputs {
    // The photo's colours from the scene's: a row per channel, the offset in w.
    matrix: array<vec4f, 3>,
    // Coefficients of the background: red, green, blue, unused.
    background: array<vec4f, 9>,
    // Share of SSIM in the loss, weight of the sky's term per pixel, largest share left out, unused.
    numbers: vec4f,
    // How many coefficients; 1 if there is a matrix; what is left out: nothing, initial transients, or by residuals;
    // unused.
    modes: vec4u,
}

const LEAVE_INITIAL_TRANSIENTS: u32 = 1u;
const LEAVE_RESIDUALS: u32 = 2u;

// Of a target's pixel: red, green, blue and flags, a byte each.
fn has(pixel: u32, flag: u32) -> bool {
    return ((pixel >> 24u) & flag) != 0u;
}

fn colour_of(pixel: u32) -> vec3f {
    return unpack4x8unorm(pixel).xyz;
}
