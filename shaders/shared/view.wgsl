// Camera, pose and options, as the host lays them out (`View` in services/gpu/src/engine.rs).
struct View {
    // World to camera: a row of the rotation, and the translation in w.
    row_x: vec4f,
    row_y: vec4f,
    row_z: vec4f,
    // fx, fy, cx, cy.
    lens: vec4f,
    // Range of x/z and of y/z in which the Jacobian follows the perspective.
    limits: vec4f,
    // Low-pass in px², 1 for anti-aliasing, nearest depth, unused.
    options: vec4f,
    // Width and height in pixels; columns and rows of tiles.
    frame: vec4u,
}
