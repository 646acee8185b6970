//! The scene tree: nested groups of splats that the boundaries of all views agree on (method, section 13).
//!
//! Each view is added with its boundary map ([`TreeBuilder::add`]), unless enough others see what it sees. The map is a model's, or
//! made of the outlines of automatic masks ([`mask_outlines()`]). Two splats are as far apart as the median, over the views that see
//! both, of the height at which their pixels' regions merge, as the gap of their surfaces in 3D, or as both together. Trees are grown
//! from each of these distances ([`TreeBuilder::grow`]): by average linkage, and by distances in the eigenvectors of the whole graph.
//! Surfaces that run on under what stands there are found by their shape ([`SceneSurface`]). Clicks choose a group from all trees
//! ([`SceneTree::candidates`]), or a surface ([`SceneTree::surface_at`]).

mod boundaries;
mod boxes;
mod corrections;
mod describable;
mod front_values;
mod graph;
mod growth;
mod leaf_map;
mod mask_outlines;
mod node_surface;
mod parts;
mod query;
mod region_merges;
mod sightings;
mod spectral;
mod surfaces;
mod tree;

pub(crate) use boxes::{BoxedGroups, BoxedLeaves};
pub use corrections::{CorrectedLeaves, LeafClick, ShownLeaves};
pub use describable::MOST_DESCRIBABLE;
pub(crate) use graph::ENOUGH_VIEWS;
pub use graph::{FrontBorder, SplatEdge, SplatGraph, SplatsInView, TreeBuilder};
pub use leaf_map::{LeafMap, ShownPixels};
pub use mask_outlines::mask_outlines;
pub use parts::{MOST_PARTS, PartMap, SceneParts};
pub use query::GroupCandidate;
pub(crate) use query::{SCENE_AREA, SURFACE_IOU};
pub use segwild_vision::linkage::MergeTree;
pub use tree::{GroupTree, NONE, SceneSurface, SceneTree, SplatGroup};
