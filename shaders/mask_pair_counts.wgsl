// Number of other sampled pixels that share a mask with each, and number of those that share none (twin: `compactness`
// in objective/src/field/compact.rs). A workgroup per pixel.
#import common
#import sum
#import masks

alias Summed = vec2f;

// x: pixels, y: words of a set.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<storage, read> groups_of: array<u32>;
@group(0) @binding(2) var<storage, read> sets: array<u32>;
// Of `unit_features`.
@group(0) @binding(3) var<storage, read> lengths: array<f32>;
@group(0) @binding(4) var<storage, read_write> counts: array<vec2f>;

@compute @workgroup_size(256)
fn mask_pair_counts(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let pixel = group_of(id, groups);
    var mine = vec2f(0.0);
    if pixel < job.x && lengths[pixel] > 0.0 {
        for (var other = local; other < job.x; other += 256u) {
            if other != pixel && lengths[other] > 0.0 {
                let alike = similarity(groups_of[pixel], groups_of[other], job.y) > 0.0;
                mine += select(vec2f(0.0, 1.0), vec2f(1.0, 0.0), alike);
            }
        }
    }
    let all = sum_of_group(local, mine);
    if local == 0u && pixel < job.x {
        counts[pixel] = all;
    }
}
