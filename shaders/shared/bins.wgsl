// Bins of residuals (twins: `bin` and `bin_top` in objective/src/transients/residuals.rs).
fn bin_of(residual: f32) -> u32 {
    // NaN falls in the last bin.
    if !finite(residual) {
        return BINS - 1u;
    }
    return min(u32(max(residual, 0.0) * f32(BINS)), BINS - 1u);
}

fn bin_top(bin: u32) -> f32 {
    return f32(bin + 1u) / f32(BINS);
}
