//! Transients: what a photo shows and the scene does not, such as people, cars and scaffolds.
//!
//! `RUN/transients/PHOTO.png` is white where a transient stands, in pixels of the photo as taken. A person may edit
//! such a mask image. `made.json` beside the images lists the pixels that this program wrote, and what it wrote them
//! from. An image with other pixels is a person's correction: the program never overwrites it, and the next run leaves
//! out of the photo exactly what it marks. A damaged image is made again.
//!
//! | module | what it does |
//! |---|---|
//! | [`corrections`] | reads the masks that a person has corrected |
//! | [`authorship`] | decides who wrote a mask image: this program, a person, or a damaged disk |
//! | [`images`] | writes and reads the mask images in the run folder |
//! | [`known`] | the transients of a photo that are known before the training |
//! | [`finding`] | finds the transients of a photo after the training |
//! | [`odd`] | warnings about the transients of photos |
//! | [`scoring`] | scores the mask images against true masks |
//! | [`visibility`] | compares a photo with the trained scene, pixel by pixel |

pub(crate) mod authorship;
mod corrections;
mod finding;
mod images;
mod known;
mod odd;
mod scoring;
mod visibility;

pub use authorship::TrainFit;
pub(crate) use corrections::Corrections;
pub(crate) use images::{
    TransientMaskWriter, damaged, digest_of_run, of_run, read_image, versions_of_run, write_image,
};
pub(crate) use known::KnownTransients;
pub use scoring::{TransientScore, TransientScores, score_transients};
pub(crate) use visibility::visibility;
