//! Blocks of a scene whose training does not fit in memory (method, section 9): where they lie, which photos take part
//! in each, and which of them is trained when.
//!
//! One set of splats shows the whole scene at every step. Parameters are held for all of them, optimiser moments for
//! those alone that are trained: first few splats on all photos, then the splats of one block after another with a
//! border around it on the photos that see it, then those at the seams. All others are rendered and stay as they are,
//! so that no block invents a background, and what two blocks show is never trained twice and joined: there is one of
//! it.

mod division;
mod turns;

pub use division::trained_share;
pub(crate) use division::{Aabb, is_divisible};
pub(crate) use turns::{BlockPart, BlockTurn, BlockTurns, SEAMS};
