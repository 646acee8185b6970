// Gradient of the loss by a splat's blending weight at a pixel: the dot product of the splat's values and the pixel's
// gradients. With BLOCKS = 0 there may be any number of channels, read from memory as they come; else they are held in
// registers.
const REGISTERS: u32 = max(BLOCKS, 1u);

fn weight_grad_from_memory(splat: u32, position: u32, blocks: u32) -> f32 {
    var sum = 0.0;
    for (var b = 0u; b < blocks; b += 1u) {
        sum += dot(values[splat * blocks + b], grads[position * blocks + b]);
    }
    return sum;
}
