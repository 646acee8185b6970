//! What all passes have in common.

use crate::GpuError;

/// Passes over inputs that lie on the device; each is recorded, and submitted with those before it.
pub trait DevicePasses {
    /// Submits what was recorded, and waits until all of it is done.
    ///
    /// # Errors
    /// When the device failed.
    fn wait(&mut self) -> Result<(), GpuError>;
}
