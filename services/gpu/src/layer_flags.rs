//! Flags of a layer of the networks, for the uniform that describes it and for the kernels that read it.

/// No offset.
pub(crate) const NOWHERE: u32 = u32::MAX;
/// A ReLU follows.
pub(crate) const RELU: u32 = 1;
/// The result is added to the present values.
pub(crate) const ADD: u32 = 2;
/// The kernel is turned round.
pub(crate) const TURNED: u32 = 4;
/// Four planes read are the quarters of one: every other pixel of every other row.
pub(crate) const READ_QUARTERS: u32 = 8;
/// So are four that are written.
pub(crate) const WRITE_QUARTERS: u32 = 16;
/// Columns are splats in sight.
pub(crate) const COUNTED: u32 = 32;
/// The same for the kernels.
pub(crate) const CONSTANTS: [(&str, u32); 7] = [
    ("NOWHERE", NOWHERE),
    ("RELU", RELU),
    ("ADD", ADD),
    ("TURNED", TURNED),
    ("READ_QUARTERS", READ_QUARTERS),
    ("WRITE_QUARTERS", WRITE_QUARTERS),
    ("COUNTED", COUNTED),
];
