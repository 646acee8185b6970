// Colours of the splats in a photo's light (twin: `EmbedAppearance::tint` in objective/src/appearance/embed.rs). One thread per splat.
#import common
#import light

// x: splats, y: vec4 of an embedding, z: where those of this appearance model start.
@group(0) @binding(0) var<uniform> job: vec4u;
@group(0) @binding(1) var<uniform> photo: Photo;
// Red, green, blue, and 1.
@group(0) @binding(2) var<storage, read> colours: array<vec4f>;
@group(0) @binding(3) var<storage, read> splat_embeddings: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> tinted: array<vec4f>;

@compute @workgroup_size(256)
fn tint(
    @builtin(workgroup_id) id: vec3u,
    @builtin(num_workgroups) groups: vec3u,
    @builtin(local_invocation_index) local: u32,
) {
    let i = group_of(id, groups) * 256u + local;
    if i >= job.x {
        return;
    }
    let own = colours[i];
    var colour = vec4f(0.0, 0.0, 0.0, own.w);
    for (var c = 0u; c < 3u; c += 1u) {
        let at = job.y * i + job.z + 2u * c;
        let light = dot(photo.vector[2u * c], splat_embeddings[at]) + dot(photo.vector[2u * c + 1u], splat_embeddings[at + 1u]);
        colour[c] = dot(photo.matrix[c], vec4f(own.xyz, 1.0)) + light;
    }
    tinted[i] = colour;
}
