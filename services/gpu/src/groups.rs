//! Sizes of thread groups, of tiles and of sort keys, and how groups are laid out.

/// Threads of a group that does one item per thread.
pub(crate) const GROUP: usize = 256;
/// Width and height of a tile; as in `shaders/shared/common.wgsl`.
pub(crate) const TILE: u32 = 16;
/// Groups per dimension that every device offers.
const MOST_PER_ROW: usize = 65_535;
/// Bits of a splat's sort key: its depth as a number of type `f32`, counted from the nearest depth, up to 2^32 times that; seven
/// digits of the sort.
pub(crate) const DEPTH_BITS: u32 = 28;

/// Groups per row and rows that hold at least so many groups, at least one. A kernel counts along the rows (`group_of` of
/// `shaders/shared/common.wgsl`) and leaves out what is too many in the last.
pub(crate) fn rows_of(groups: usize) -> [u32; 2] {
    let columns = groups.clamp(1, MOST_PER_ROW);
    [columns as u32, groups.div_ceil(columns).max(1) as u32]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_groups_than_a_dimension_holds_are_laid_out_in_rows() {
        assert_eq!((rows_of(1), rows_of(65_535), rows_of(65_536)), ([1, 1], [65_535, 1], [65_535, 2]));
        // One group per splat of five million, one per bucket of 40 million pairs, and per pair of as many as can be numbered.
        for groups in [5_000_000, 40_000_000 / 64, u32::MAX as usize / GROUP, 65_535 * 65_535] {
            let [columns, rows] = rows_of(groups).map(|n| n as usize);
            assert!(columns <= MOST_PER_ROW && rows <= MOST_PER_ROW, "{groups}: {columns} x {rows}");
            assert!(
                columns * rows >= groups && columns * (rows - 1) < groups,
                "{groups}: {columns} x {rows}"
            );
            // The shaders count groups in 32 bits.
            assert!(columns * rows <= u32::MAX as usize, "{groups}: {columns} x {rows}");
        }
    }
}
