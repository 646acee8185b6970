//! Why a file of a CLIP model, or its tokenizer, cannot be used.

/// Why a network file with the outputs of CLIP cannot be used. The words follow the file's name, which the caller adds.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ClipFileError {
    /// It takes more than images and texts.
    #[error("takes {names} as well; CLIP's encoders take `pixel_values`, `input_ids` and `attention_mask`")]
    Inputs {
        /// The names of the other inputs.
        names: String,
    },
    /// An input has another type or shape than it must have.
    #[error("its input `{name}` is {found}; {expected} was expected")]
    Input {
        /// The input.
        name: String,
        /// Its type and shape.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
    /// The two encoders of a pair do not belong together.
    #[error("answers {texts} numbers per text, and {file} {images} per image: they do not fit each other")]
    Pair {
        /// Numbers per text.
        texts: usize,
        /// The image encoder's file.
        file: String,
        /// Numbers per image.
        images: usize,
    },
}

/// Why a tokenizer, or the file that says how images are scaled, cannot be used. The words follow the file's name.
#[derive(Debug, thiserror::Error)]
pub enum TokenizerError {
    /// The system refuses the file, or it is larger than any such file.
    #[error("cannot be read: {0}")]
    Unreadable(std::io::Error),
    /// It is no JSON, or not of a tokenizer.
    #[error("is not what stands beside a CLIP model: {0}")]
    Json(serde_json::Error),
    /// It is no text.
    #[error("is no text in UTF-8")]
    NoText,
    /// It splits texts in another way.
    #[error("is a tokenizer of type `{0}`; CLIP has byte pairs (`BPE`)")]
    Type(String),
    /// Its byte pairs are another model's: they do not mark the ends of words.
    #[error("is no tokenizer of CLIP: none of its merges ends a word (`</w>`)")]
    NoWordEnds,
    /// It holds more than any tokenizer of CLIP.
    #[error("has more than {0} tokens or merges, which no tokenizer of CLIP has")]
    TooMany(usize),
    /// A merge is none.
    #[error("its merge {number} is `{text}`; two pieces were expected")]
    Merge {
        /// Its number, from 1.
        number: usize,
        /// What is there.
        text: String,
    },
    /// A token is missing.
    #[error("has no token `{0}`")]
    NoToken(String),
    /// How images are scaled makes no sense.
    #[error("its `{name}` is {found}")]
    Scaling {
        /// The entry.
        name: &'static str,
        /// What is there, and what was expected.
        found: String,
    },
}
