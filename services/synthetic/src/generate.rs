//! Builds the scene of a seed, and takes its photos.

use crate::error::SyntheticError;
use crate::options::SyntheticOptions;
use crate::plan::SyntheticPlan;
use crate::scene::SyntheticScene;

/// Makes the set in memory, about 32 bytes for each pixel of its photos; [`SyntheticPlan`] makes it photo by photo. The same options
/// give the same bytes, whatever the number of threads.
pub fn generate(options: &SyntheticOptions) -> Result<SyntheticScene, SyntheticError> {
    let plan = SyntheticPlan::new(options)?;
    let photos = plan.photos().collect();
    Ok(plan.with_photos(photos))
}
