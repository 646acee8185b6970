//! What the front splat of each pixel of a view has.

use crate::PosedView;
use segwild_raster::{CpuEngine, ProjectOptions, RasterError};
use segwild_scene::Splats;

/// Accumulated alpha `A` under which a pixel shows no part (method, section 13). By choice; for the list and for texts alone.
const MIN_PART_ALPHA: f32 = 0.5;

/// Values of the pixels of a view.
pub(super) struct FrontValues<T> {
    /// Pixels of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Per pixel, row by row, its value.
    pub values: Vec<T>,
}

/// Renders the values of splats into a view: a pixel has the value of the splat that makes up most of it. `value` is called without
/// a splat for pixels that show none. One engine serves all views of a scene: its buffers are used again.
///
/// # Errors
/// When the scene cannot be rendered.
pub(super) fn front_values<T>(
    engine: &CpuEngine,
    splats: &Splats,
    options: &ProjectOptions,
    view: &PosedView,
    value: impl Fn(Option<usize>) -> T,
) -> Result<FrontValues<T>, RasterError> {
    let front = engine.front(splats, &view.camera, &view.pose, options)?;
    let of_pixel =
        |(&splat, &alpha): (&u32, &f32)| value((alpha >= MIN_PART_ALPHA).then_some(splat as usize));
    let values = front.splats.iter().zip(&front.alpha.data).map(of_pixel).collect();
    Ok(FrontValues { width: front.width, height: front.height, values })
}
