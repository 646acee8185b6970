// Sums for the sky over a photo's sky and whatever else no splat covers (twin: `SkySums::of_photo` in
// objective/src/background.rs). One thread per pixel of a coarse grid, then one per sum over those of the group.
#import common
#import view
#import loss_inputs
#import background

// x: pixels of the grid, y: its width.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> image: array<vec4f>;
@group(0) @binding(3) var<storage, read> photo: array<u32>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
// SKY_SUMS per group.
@group(0) @binding(5) var<storage, read_write> parts: array<f32>;

// Of the products of two basis functions, the lower half.
const PRODUCTS: u32 = 45u;
// Then of basis functions times colours, and the weights'.
const SKY_SUMS: u32 = PRODUCTS + 27u + 1u;

// Per pixel: the basis functions, the colour, the weight.
var<workgroup> seen: array<array<f32, 13>, 256>;

@compute @workgroup_size(256)
fn sky_sums(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let k = group * 256u + local;
    var weight = 0.0;
    if k < job.x {
        let x = k % job.y * STRIDE;
        let y = k / job.y * STRIDE;
        let i = y * view.frame.x + x;
        let open = max(1.0 - image[i].w, 0.0);
        weight = select(open * open * weights[i], 1.0, has(photo[i], SKY));
        weight = select(0.0, weight, weight > LEAST_SEEN);
        var basis = sky_basis(direction_through(view, x, y));
        for (var b = 0u; b < 9u; b += 1u) {
            seen[local][b] = basis[b];
        }
        let colour = colour_of(photo[i]);
        seen[local][9] = colour.x;
        seen[local][10] = colour.y;
        seen[local][11] = colour.z;
    } else {
        for (var b = 0u; b < 12u; b += 1u) {
            seen[local][b] = 0.0;
        }
    }
    seen[local][12] = weight;
    workgroupBarrier();
    if local >= SKY_SUMS || group * 256u >= job.x {
        return;
    }
    // Which two numbers of a pixel this sum is of; the first basis function is 1.
    var a = 0u;
    var b = 0u;
    if local < PRODUCTS {
        // Row a of the lower half starts at a (a + 1) / 2.
        while (a + 1u) * (a + 2u) / 2u <= local {
            a += 1u;
        }
        b = local - a * (a + 1u) / 2u;
    } else if local < PRODUCTS + 27u {
        a = (local - PRODUCTS) / 3u;
        b = 9u + (local - PRODUCTS) % 3u;
    }
    var sum = 0.0;
    for (var p = 0u; p < 256u; p += 1u) {
        sum += seen[p][12] * seen[p][a] * seen[p][b];
    }
    parts[SKY_SUMS * group + local] = sum;
}
