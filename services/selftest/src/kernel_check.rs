//! What a comparison says of kernels.

use crate::mismatch::Mismatch;

/// One step of a frame, compared.
#[derive(Clone, Debug)]
pub struct KernelCheck {
    /// The kernels that it runs and that no earlier step has checked.
    pub kernels: &'static [&'static str],
    /// The difference; `None` if it is within the tolerance.
    pub off: Option<Mismatch>,
}
