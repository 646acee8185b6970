//! How much of each pixel splats cover.

use crate::RunError;
use segwild_raster::{Channels, Projected};
use segwild_scene::Image;

/// How much of each pixel the splats cover, 0 to 1.
pub(crate) fn cover(projected: &dyn Projected) -> Result<Image, RunError> {
    Ok(projected.blend(&Channels { count: 0, values: &[] })?.alpha)
}
