//! The stage `poses`: COLMAP computes the camera poses of photos that come without, before anything else can start. Skies
//! and embeddings are of undistorted photos, and the lens is one of the things that COLMAP finds.

use crate::run::node::{Performer, StageNode, StageWork};
use crate::run::results::StageResults;
use crate::run::stage::Stage;

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Poses,
    by: Performer::Programs,
    feed: None,
    needs: &[],
    // In the ledger the stage has the key of its photos, which is made before any other; this is of what it gives.
    results: StageResults::Rewritten(|keys| keys.training),
    work: StageWork::Before,
};
