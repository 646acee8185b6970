//! A block of coefficients, and where decoded blocks go.

/// Where the coefficients lie in a block, in the order in which they are written.
#[rustfmt::skip]
pub(super) const ZIGZAG: [u8; 64] = [
     0,  1,  8, 16,  9,  2,  3, 10, 17, 24, 32, 25, 18, 11,  4,  5,
    12, 19, 26, 33, 40, 48, 41, 34, 27, 20, 13,  6,  7, 14, 21, 28,
    35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51,
    58, 59, 52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];

/// A block of 8 x 8 coefficients, row by row.
pub(super) type CoefficientBlock = [i16; 64];

/// Takes the blocks of an image.
pub(super) trait BlockSink {
    /// How many coefficients of a component's blocks are wanted, across and down; 0: none.
    fn wanted(&self, component: usize) -> (usize, usize);
    /// A block of a component, with its index among the component's blocks and the table to multiply it by.
    fn block(&mut self, component: usize, at: (usize, usize), block: &CoefficientBlock, table: &[u16; 64]);
}
