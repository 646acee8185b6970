// One step of the optimiser (twin: `Adam::step` in objective/src/adam.rs). One thread per number; numbers come in items of a
// few, one item per splat.
#import common

struct Rule {
    beta1: f32,
    beta2: f32,
    rate: f32,
    epsilon: f32,
}

struct Rules {
    // Of an item's first `split` numbers, and of the others.
    first: Rule,
    second: Rule,
    // Where an item's gradients start, and the distance to those of the next one; numbers of an item that are
    // parameters; `split`.
    item: vec4u,
}

// x: numbers, y: numbers of an item, z: 1 if splats out of sight are not stepped, w: bits of the factor by which a
// parameter of the second rule decays.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> rules: Rules;
@group(0) @binding(2) var<storage, read> grads: array<f32>;
@group(0) @binding(3) var<storage, read_write> parameters: array<f32>;
@group(0) @binding(4) var<storage, read_write> first: array<f32>;
@group(0) @binding(5) var<storage, read_write> second: array<f32>;
// Depth, radius, centre per splat.
@group(0) @binding(6) var<storage, read> seen: array<vec4f>;
// Of `emit`: a view whose pairs exceed the capacity is skipped.
@group(0) @binding(7) var<storage, read> found: array<u32>;

const LARGEST: f32 = 3.4028235e38;

@compute @workgroup_size(256)
fn adam(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let k = group_of(id, groups) * 256u + local;
    if k >= job.x || found[1] == 0u {
        return;
    }
    let lane = k % job.y;
    if lane >= rules.item.z || (job.z == 1u && !(seen[k / job.y].y > 0.0)) {
        return;
    }
    var rule = rules.first;
    if lane >= rules.item.w {
        rule = rules.second;
    }
    var g = grads[rules.item.x + (k / job.y) * rules.item.y + lane];
    // It would stay in the moments for ever.
    g = select(0.0, g, finite(g));
    let m = rule.beta1 * first[k] + (1.0 - rule.beta1) * g;
    let v = rule.beta2 * second[k] + (1.0 - rule.beta2) * g * g;
    let held = select(LARGEST, v, finite(v));
    first[k] = m;
    second[k] = held;
    let step = rule.rate * m / (sqrt(held) + rule.epsilon);
    let kept = select(1.0, bitcast<f32>(job.w), lane >= rules.item.w);
    parameters[k] = (parameters[k] - select(0.0, step, finite(step))) * kept;
}
