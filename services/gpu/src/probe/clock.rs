//! The device's own clock.

use crate::{GpuEngine, GpuError};
use std::collections::BTreeMap;

/// Times every kernel from now on, if the device has a clock of its own. Reading the times waits for the submitted work.
pub fn start_clock(engine: &GpuEngine) {
    engine.device.start_clock();
}

/// Milliseconds of each kernel since then, by its name; none where the device has no clock.
pub fn stop_clock(engine: &GpuEngine) -> BTreeMap<&'static str, f64> {
    engine.device.stop_clock()
}

/// Waits until everything that was submitted is done.
///
/// # Errors
/// When the device failed.
pub fn wait(engine: &GpuEngine) -> Result<(), GpuError> {
    engine.device.work().wait()
}
