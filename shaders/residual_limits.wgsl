// The residuals from which on a pixel is left out (twin: `residual_limits` in
// objective/src/transients/residuals.rs). One thread: it goes over the bins a few times.
#import common
#import loss_inputs
#import bins

// x: 1 if the photo was visited before, y: where its residuals go.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> loss_inputs: LossInputs;
@group(0) @binding(2) var<storage, read> counts: array<u32>;
// Decaying shares of earlier visits.
@group(0) @binding(3) var<storage, read> before: array<f32>;
// The limit, that of initial transients, and that of this visit alone.
@group(0) @binding(4) var<storage, read_write> limits: array<f32>;
// BINS shares with this visit's, and how many pixels counted.
@group(0) @binding(5) var<storage, read_write> results: array<f32>;

const NONE: f32 = 3.4028235e38;

var<private> fresh: array<f32, BINS>;
var<private> held: array<f32, BINS>;

fn quantile(of_held: bool, q: f32) -> f32 {
    var total = 0.0;
    for (var b = 0u; b < BINS; b += 1u) {
        total += select(fresh[b], held[b], of_held);
    }
    var sum = 0.0;
    for (var b = 0u; b < BINS; b += 1u) {
        sum += select(fresh[b], held[b], of_held);
        if sum >= q * total {
            return bin_top(b);
        }
    }
    return 1.0;
}

fn threshold(of_held: bool, share: f32) -> f32 {
    return max(max(quantile(of_held, 1.0 - share), CONTRAST * quantile(of_held, 0.5)), FLOOR);
}

@compute @workgroup_size(1)
fn residual_limits() {
    var pixels = 0u;
    for (var b = 0u; b < BINS; b += 1u) {
        pixels += counts[b];
    }
    results[job.y + BINS] = f32(pixels);
    if pixels == 0u {
        limits[0] = NONE;
        limits[1] = NONE;
        limits[2] = FLOOR;
        return;
    }
    for (var b = 0u; b < BINS; b += 1u) {
        fresh[b] = f32(counts[b]) / f32(pixels);
        held[b] = fresh[b];
        if job.x == 1u {
            held[b] = DECAY * before[b] + (1.0 - DECAY) * fresh[b];
        }
        results[job.y + b] = held[b];
    }
    let share = loss_inputs.numbers.z;
    var limit = threshold(true, share);
    var over = 0.0;
    for (var b = 0u; b < BINS; b += 1u) {
        if bin_top(b) > limit {
            over += fresh[b];
        }
    }
    // The photo changed faster than its history: this visit alone is trusted, so that never more than the share goes.
    if over > SURPRISE * share {
        limit = max(limit, threshold(false, share));
    }
    limits[0] = limit;
    limits[1] = INITIAL_TRANSIENT_SHARE * limit;
    limits[2] = threshold(false, share);
}
