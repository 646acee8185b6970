//! What each photo shows that the scene does not: people, cars, scaffolds.
//!
//! | module | what it does |
//! |---|---|
//! | [`corrections`] | the masks that a person has put right |
//! | [`authorship`] | who made the mask image of a photo: this program, a person, or a damaged disk |
//! | [`visibility`] | which pixels of a photo agree with the trained scene |

pub(crate) mod authorship;
mod corrections;
mod visibility;

pub(crate) use corrections::{Album, Corrections, Known, damaged, of_run};
pub use corrections::{TransientScore, TransientScores, score_transients};
pub(crate) use visibility::visibility;
