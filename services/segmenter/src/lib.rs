//! Actor: prompts to selection to spike cut to object (method, sections 6, 7 and 10).
//!
//! [`select`] turns masks and clicks on some photos into labels on splats, carrying them to the other photos
//! and to parts that nobody prompted; [`SpikeCut`] shortens the splats that stick out; [`SelectedObject`], [`visible_mask`]
//! and [`amodal_mask`] are its results. Usable without the other actors: everything is a function of
//! splats, cameras and masks.
//!
//! It has no 2D model: the masks of prompts come in, and a [`Refiner`] answers where it needs one more.
//!
//! ```
//! use segwild_segmenter::FlowNetwork;
//!
//! // Two splats of different labels and a weak edge: the cut goes through the edge.
//! let mut network = FlowNetwork::new(2);
//! network.add_terminal(0, 9, 0);
//! network.add_terminal(1, 0, 9);
//! network.add_edge(0, 1, 2, 2);
//! network.solve();
//! assert!(network.in_source(0) && !network.in_source(1));
//! ```
//!
//! Start reading at `select.rs`, then `label_fusion.rs`; single clicks start at `scene_tree/`.

mod actor;
mod box_bounds;
mod components;
mod confidence;
pub mod coverage;
mod depth_layers;
mod error;
mod feature_clusters;
mod graph;
mod label_fusion;
mod maxflow;
mod multi_view_cut;
mod object;
mod occlusion;
mod open_views;
mod photo_agreement;
mod photo_evidence;
mod propagate;
mod query;
mod refiner;
mod request;
pub mod scene_tree;
mod screen;
mod seen_once;
mod select;
mod settings;
mod sgc;
mod sides;
mod smooth;
mod spread;
mod steps;
mod svd;
mod thin_structures;
mod tree_answer;
mod view_splats;

pub use actor::{PhotoReader, SegmentActor, SegmentReply, SegmentTask, Segmented};
pub use confidence::{Lopsided, SelectionConfidence, counted};
pub use coverage::Evidence;
pub use error::SegmentError;
pub use graph::{NeighbourGraph, SceneAffinities, SceneGraph};
pub use maxflow::FlowNetwork;
pub use multi_view_cut::MaskVote;
pub use object::{MaskMode, SelectedObject, amodal_mask, cut_scene, owned, visible_mask};
pub use photo_agreement::PhotoAgreement;
pub use propagate::{PhotoVerdict, PhotoVisit};
pub use query::{ClickHit, ClickHits, SplatFeatures, SplatFeatures as FeatureField, hit};
pub use refiner::Refiner;
pub use request::{MaskReader, PosedView, PromptedView, Request};
pub use select::{Selection, cut, select};
pub use settings::{
    ComponentRule, CutBy, EvidenceMode, FirstAnswer, SegmentSettings, SimilarityUse, SpikeMode,
    TreeBoundaries, Undecided, Vote,
};
pub use sgc::{CutView, SpikeCut, SplatGeometry};
pub use sides::{ShownSide, SideAgreement};
pub use smooth::graph_cut;
pub use spread::{Belief, spread};
pub use steps::{AnswerStep, AnswerSteps};
pub use tree_answer::Alternative;
pub use view_splats::ViewSplats;
