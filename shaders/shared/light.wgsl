// Parameters of a photo in the appearance model `embed` (`PHOTO` in objective/src/appearance/embed.rs): a matrix with
// offset, row by row, and a vector of eight numbers per colour channel. A splat's embedding is laid out as the vector.
struct Photo {
    matrix: array<vec4f, 3>,
    vector: array<vec4f, 6>,
}

// Vec4 of a photo, and their numbers.
const PHOTO_VECS: u32 = 9u;
