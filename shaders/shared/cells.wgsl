// Which pixels a cell of the embedding's grid averages (`AreaAverage` in objective/src/field/area.rs), as the host lays it
// out in services/gpu/src/field/feature_target.rs: width and height of the view, then of the grid; where the columns'
// windows start, the rows', the parts of each column of pixels, of each row; windows (first pixel, pixels, where their
// weights start), parts (first cell, cells), and the bits of the weights.

// A window along one axis, the `at`th of those that start at `windows`.
struct Window {
    start: u32,
    count: u32,
    weights: u32,
}

fn window_of(windows: u32, at: u32) -> Window {
    let position = windows + 3u * at;
    return Window(cells[position], cells[position + 1u], cells[position + 2u]);
}

// The share of a pixel in the window.
fn share_of(window: Window, pixel: u32) -> f32 {
    return bitcast<f32>(cells[window.weights + pixel - window.start]);
}
