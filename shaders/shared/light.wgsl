// What the look `embed` trains of a photo (`PHOTO` in raster/src/look/embed.rs): a matrix with offset, row by row, and a
// vector of eight numbers per colour channel. A splat's code is laid out as the vector.
struct Photo {
    matrix: array<vec4f, 3>,
    vector: array<vec4f, 6>,
}

// Vec4 of a photo, and how many numbers they are.
const PHOTO_VECS: u32 = 9u;
