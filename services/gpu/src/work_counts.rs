//! What a device is given to do, counted: the same for the same work on every device.

use std::ops::Sub;

/// Counts since the device was opened; the difference of two is of the work in between.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WorkCounts {
    /// Kernels launched. Each waits for the one before: there is a barrier in front of it.
    pub launches: u64,
    /// Compute passes that hold them.
    pub passes: u64,
    /// Copies and clears by the device.
    pub copies: u64,
    /// Submissions to the device's queue.
    pub submissions: u64,
    /// How often the host waited for the device.
    pub waits: u64,
    /// Arrays uploaded.
    pub uploads: u64,
    /// Their bytes.
    pub uploaded_bytes: u64,
    /// Bytes downloaded.
    pub downloaded_bytes: u64,
    /// Bytes of the arrays of all launches: what they move if each reads or writes its arrays once.
    pub bound_bytes: u64,
}

impl Sub for WorkCounts {
    type Output = WorkCounts;

    fn sub(self, before: WorkCounts) -> WorkCounts {
        WorkCounts {
            launches: self.launches - before.launches,
            passes: self.passes - before.passes,
            copies: self.copies - before.copies,
            submissions: self.submissions - before.submissions,
            waits: self.waits - before.waits,
            uploads: self.uploads - before.uploads,
            uploaded_bytes: self.uploaded_bytes - before.uploaded_bytes,
            downloaded_bytes: self.downloaded_bytes - before.downloaded_bytes,
            bound_bytes: self.bound_bytes - before.bound_bytes,
        }
    }
}
