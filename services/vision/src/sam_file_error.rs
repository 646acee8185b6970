//! Why a file of the SAM family cannot be used.

/// Why a network file is none that answers clicks. The words follow the file's name, which the caller adds.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SamFileError {
    /// An image encoder takes one photo.
    #[error("takes {count} inputs ({names}); an image encoder takes one photo")]
    EncoderInputs {
        /// How many it takes.
        count: usize,
        /// Their names.
        names: String,
    },
    /// An encoder's input is no photo.
    #[error(
        "its input `{name}` is {found}; an image encoder takes float32 or float16 [1, 3, h, w], or [h, w, 3] in float32 or uint8"
    )]
    Photo {
        /// The input.
        name: String,
        /// Its type and shape.
        found: String,
    },
    /// An encoder's photo is smaller or larger than any encoder's.
    #[error("its input `{name}` is {found}: a side of {side} pixels is none of an image encoder")]
    Side {
        /// The input.
        name: String,
        /// Its type and shape.
        found: String,
        /// The side.
        side: usize,
    },
    /// An encoder answers no embedding.
    #[error("answers {found}; an image encoder answers float32 [1, 256, 64, 64]")]
    EncoderOutputs {
        /// What it answers.
        found: String,
    },
    /// A decoder takes other inputs than any known one.
    #[error("takes {found}; a prompted decoder takes {expected}")]
    DecoderInputs {
        /// The names of its inputs.
        found: String,
        /// Those of the most similar interface.
        expected: String,
    },
    /// An input has another type or shape than it must have.
    #[error("its input `{name}` is {found}; {expected} was expected")]
    Input {
        /// The input.
        name: String,
        /// Its type and shape.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A file fixes more prompts than are ever given.
    #[error("takes {count} prompts at a time; more than {most} are not given")]
    TooMany {
        /// Prompts, or points per prompt.
        count: usize,
        /// The limit.
        most: usize,
    },
    /// A decoder answers no masks with scores.
    #[error(
        "answers {found}; `low_res_masks` [{dims}, M, s, s] and `iou_predictions` [{dims}, M] were expected"
    )]
    DecoderOutputs {
        /// What it answers.
        found: String,
        /// The dimensions before the masks.
        dims: &'static str,
    },
    /// The two files of a pair do not belong together.
    #[error(
        "is a decoder of {decoder}'s kind, and {file} an encoder of {encoder}'s: they do not fit each other"
    )]
    Pair {
        /// The decoder's family.
        decoder: &'static str,
        /// The encoder's file.
        file: String,
        /// The encoder's family.
        encoder: &'static str,
    },
    /// SAM 3's model of text and exemplars, which takes no clicks.
    #[error(
        "is SAM 3's {part}. It finds objects by text or by exemplars ({names}) and takes no clicks. SAM 3's tracker takes them \
         (`vision_encoder.onnx` and `prompt_encoder_mask_decoder.onnx`), and so do SAM 2, MobileSAM and SAM"
    )]
    Concept {
        /// What the file is.
        part: &'static str,
        /// The inputs or outputs that show it.
        names: String,
    },
    /// A decoder for videos, which chooses a mask by itself.
    #[error(
        "follows an object through a video: it answers one mask ({found}) and no scores. Export the decoder for images \
         (samexporter has `export_sam2`)"
    )]
    Video {
        /// What it answers.
        found: String,
    },
    /// A decoder for clicks alone was given a box.
    #[error("takes clicks and no boxes: click on the object instead")]
    NoBoxes,
}
