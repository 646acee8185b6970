// From the gradients of the tinted colours to those of the splats' own, of their embeddings, and of the photo's
// parameters (twin: `EmbedAppearance::tint_backward` in objective/src/appearance/embed.rs). One thread per splat; each
// group writes the sums over its own splats, which `sum_groups` adds up.
#import common
#import light
#import sum

alias Summed = vec4f;

// x: splats, y: vec4 of an embedding, z: where those of this appearance model start.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> photo: Photo;
@group(0) @binding(2) var<storage, read> colours: array<vec4f>;
@group(0) @binding(3) var<storage, read> splat_embeddings: array<vec4f>;
// Gradients of the tinted colours, and then of the splats' own.
@group(0) @binding(4) var<storage, read_write> grads: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> embedding_grads: array<vec4f>;
// PHOTO_VECS per group.
@group(0) @binding(6) var<storage, read_write> sums: array<vec4f>;

@compute @workgroup_size(256)
fn tint_backward(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let group = group_of(id, groups);
    let i = group * 256u + local;
    let there = i < job.x;
    var g = vec3f(0.0);
    var own = vec4f(0.0);
    let embedding = job.y * i + job.z;
    if there {
        g = grads[i].xyz;
        own = vec4f(colours[i].xyz, 1.0);
        var back = vec3f(0.0);
        for (var c = 0u; c < 3u; c += 1u) {
            back += g[c] * photo.matrix[c].xyz;
            embedding_grads[embedding + 2u * c] = g[c] * photo.vector[2u * c];
            embedding_grads[embedding + 2u * c + 1u] = g[c] * photo.vector[2u * c + 1u];
        }
        grads[i] = vec4f(back, grads[i].w);
    }
    for (var k = 0u; k < PHOTO_VECS; k += 1u) {
        var mine = vec4f(0.0);
        if there {
            if k < 3u {
                mine = g[k] * own;
            } else {
                mine = g[(k - 3u) / 2u] * splat_embeddings[embedding + k - 3u];
            }
        }
        let sum = sum_of_group(local, mine);
        if local == 0u && group * 256u < job.x {
            sums[PHOTO_VECS * group + k] = sum;
        }
    }
}
