//! CLIP (Radford et al. 2021): an image encoder and a text encoder whose embeddings can be compared.
//!
//! [`crate::clip_interface`] recognises the files, [`tokenizer`] turns texts into tokens, [`scaling`] is the pre-processing of images,
//! [`encoders`] runs the networks, [`choice`] finds the files that settings name.

mod choice;
mod encoders;
mod scaling;
mod tokenizer;

pub(crate) use choice::find_clip;
pub use scaling::{CLIP_MEAN, ClipScaling};
pub use tokenizer::ClipTokenizer;
