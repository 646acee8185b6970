//! The 3D filter of Mip-Splatting and of programs that build on it, as a property `filter_3D` of each splat. Programs that do not
//! know it show the splats too thin and too opaque; here it becomes part of them.

use crate::ply::header::ElementTable;
use crate::{SceneError, Splats, logit};
use std::path::Path;

/// Widens splats by their 3D filter, if the file has one, and lowers their opacities as much as that makes them larger
/// (Mip-Splatting, equation 9). Returns what was done, in words.
pub(super) fn apply(path: &Path, bytes: &[u8], splats: &mut Splats) -> Result<Option<String>, SceneError> {
    let table = ElementTable::vertices(path, bytes)?;
    let Some(column) = table.column("filter_3D") else { return Ok(None) };
    for i in 0..splats.len() {
        let filter = table.value(i, column) as f32;
        let variances = splats.log_scales[i].map(|v| (2.0 * v).exp());
        let widened = variances.map(|v| v + filter * filter);
        if !widened.iter().all(|v| v.is_finite() && *v > 0.0) {
            continue;
        }
        let shrink = variances.iter().zip(widened).map(|(v, w)| v / w).product::<f32>().sqrt();
        let opacity = (splats.opacity(i) * shrink).clamp(1e-6, 1.0 - 1e-6);
        splats.log_scales[i] = widened.map(|v| 0.5 * v.ln());
        splats.opacities[i] = logit(opacity);
    }
    Ok(Some("its 3D filter (`filter_3D`) was made part of the splats".to_owned()))
}
