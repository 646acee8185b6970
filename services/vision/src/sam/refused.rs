//! A refusal of a file.

use crate::VisionError;
use crate::onnx::NetworkModel;
use crate::sam_file_error::SamFileError;

/// The error about a file that was read and cannot be used.
pub(super) fn refused(model: &NetworkModel, reason: SamFileError) -> VisionError {
    VisionError::Sam { file: model.name().into(), reason: Box::new(reason) }
}
