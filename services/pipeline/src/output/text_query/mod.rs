//! Objects by a text: which groups of the scene tree it describes, by a model that embeds texts and images in one space.
//!
//! Each group that a text may describe is cropped from the photos that show it best, once per scene tree and model
//! ([`described`]). A query embeds its text alone, and ranks the groups by the cosine ([`ranking`]).

mod crop;
mod described;
mod prompts;
mod ranking;

pub(crate) use described::{DescribeRequest, PartlyDescribed};
pub use ranking::{TextMatch, TextRanking};
