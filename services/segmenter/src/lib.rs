//! Actor: prompts to selection to spike cut to object (method, sections 6, 7 and 10).
//!
//! [`select`] turns masks and clicks on some photos into labels on splats, carrying them to the other photos
//! and to parts that nobody prompted; [`Cut`] shortens the splats that stick out; [`Object`], [`visible_mask`]
//! and [`amodal_mask`] are what comes of it. Usable without the other actors: everything is a function of
//! splats, cameras and masks.

mod actor;
mod behind;
mod components;
pub mod coverage;
mod error;
mod graph;
mod hidden;
mod judge;
mod jury;
mod kinds;
mod lacking;
mod maxflow;
mod object;
mod propagate;
mod query;
mod refiner;
mod screen;
mod select;
mod settings;
mod sgc;
mod smooth;
mod spread;
mod svd;

pub use actor::{PhotoReader, SegmentActor, SegmentReply, SegmentTask, Segmented};
pub use coverage::Evidence;
pub use error::SegmentError;
pub use graph::Graph;
pub use jury::Juror;
pub use maxflow::FlowNetwork;
pub use object::{MaskMode, Object, amodal_mask, cut_scene, owned, visible_mask};
pub use propagate::{Verdict, Visit};
pub use query::{FeatureField, Hit, hit};
pub use refiner::Refiner;
pub use select::{MaskReader, PosedView, PromptedView, Request, Selection, cut, select};
pub use settings::{
    ComponentRule, CutBy, EvidenceMode, SegmentSettings, SimilarityUse, SpikeMode, Undecided, Vote,
};
pub use sgc::{Cut, CutView, Geometry};
pub use smooth::graph_cut;
pub use spread::{Belief, spread};
