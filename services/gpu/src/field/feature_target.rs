//! The feature target of a photo on the device, and the windows of its cells.

use crate::GpuError;
use crate::device::{DeviceWork, GpuDevice, PooledBuffer};
use crate::memory::channels_fit;
use segwild_objective::field::{AreaAverage, FeatureTarget, Window};
use std::sync::Arc;

/// A feature target on the device.
pub(crate) struct GpuFeatureTarget {
    pub device: Arc<GpuDevice>,
    /// Width and height of the view.
    pub size: [usize; 2],
    /// Cells, and planes of them.
    pub cells: usize,
    pub planes: usize,
    /// Plane after plane, scaled to the units of the features; planes are filled up to a whole number of vec4.
    pub target: PooledBuffer,
    /// Validity of each cell.
    pub trust: PooledBuffer,
    /// `cells` of `shaders/shared/cells.wgsl`.
    pub windows: PooledBuffer,
}

impl GpuFeatureTarget {
    /// Uploads it.
    pub fn upload(
        device: &Arc<GpuDevice>,
        work: &mut DeviceWork,
        feature_target: &FeatureTarget,
    ) -> Result<GpuFeatureTarget, GpuError> {
        let target = feature_target.target;
        let cells = target.width * target.height;
        let planes = target.channels.next_multiple_of(4);
        let mut scaled: Vec<f32> = target.data.iter().map(|t| t * feature_target.scale).collect();
        scaled.resize(planes * cells, 0.0);
        Ok(GpuFeatureTarget {
            device: device.clone(),
            size: feature_target.average.from().into(),
            cells,
            planes: target.channels,
            target: work.upload("the feature target", &scaled)?,
            trust: work.upload("the validity of cells", feature_target.validity)?,
            windows: work.upload("the cells' pixels", &windows(feature_target.average))?,
        })
    }

    /// The same for many steps; `None` where it would take more than its share of the device's memory.
    pub fn upload_for_many_steps(
        device: &Arc<GpuDevice>,
        feature_target: &FeatureTarget,
    ) -> Result<Option<GpuFeatureTarget>, GpuError> {
        let mut work = device.work();
        let bytes = (4 * feature_target.target.data.len()) as u64;
        // Every photo's are kept, and together they have one share.
        if !channels_fit(device.allocated_bytes() + bytes, work.budget()) {
            return Ok(None);
        }
        GpuFeatureTarget::upload(device, &mut work, feature_target).map(Some)
    }
}

/// The table of `shaders/shared/cells.wgsl`.
fn windows(average: &AreaAverage) -> Vec<u32> {
    const HEAD: usize = 8;
    let ((width, height), (columns, rows)) = (average.from(), average.to());
    let axes = [(average.columns(), width), (average.rows(), height)];
    let mut table = vec![width as u32, height as u32, columns as u32, rows as u32, 0, 0, 0, 0];
    let weights = HEAD + 3 * (columns + rows) + 2 * (width + height);
    let mut at = weights;
    for (axis, (windows, _)) in axes.iter().enumerate() {
        table[4 + axis] = table.len() as u32;
        for Window { start, weights } in windows.iter() {
            table.extend([*start as u32, weights.len() as u32, at as u32]);
            at += weights.len();
        }
    }
    for (axis, (windows, pixels)) in axes.iter().enumerate() {
        table[6 + axis] = table.len() as u32;
        let ends = |w: &Window| w.start + w.weights.len();
        for pixel in 0..*pixels {
            // Windows start and end in order.
            let first = windows.partition_point(|w| ends(w) <= pixel);
            let count = windows[first..].partition_point(|w| w.start <= pixel);
            table.extend([first as u32, count as u32]);
        }
    }
    debug_assert_eq!(table.len(), weights);
    let all = axes.iter().flat_map(|(windows, _)| windows.iter());
    table.extend(all.flat_map(|w| &w.weights).map(|w| w.to_bits()));
    table
}
