// Jaccard similarity of two sets of masks (twin: `Membership::similarity` in objective/src/field/membership.rs), of so
// many words of bits each, in `sets`.
fn similarity(a: u32, b: u32, words: u32) -> f32 {
    var both = 0u;
    var either = 0u;
    for (var k = 0u; k < words; k += 1u) {
        let left = sets[a * words + k];
        let right = sets[b * words + k];
        both += countOneBits(left & right);
        either += countOneBits(left | right);
    }
    return f32(both) / (f32(either) + 1e-5);
}
