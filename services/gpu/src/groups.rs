//! Sizes of thread groups and of tiles.

/// Threads of a group that does one item per thread.
pub(crate) const GROUP: usize = 256;
/// Width and height of a tile; as in `shaders/shared/common.wgsl`.
pub(crate) const TILE: u32 = 16;
