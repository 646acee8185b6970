//! The texts that groups are compared with.

/// The words that each text is put into (docs/method.md, section 13.1), as in CLIP's own evaluation (Radford et al. 2021, section
/// 3.1.4).
const PROMPT: &str = "a photo of ";
/// What a group may be instead (section 13.1): texts that describe anything (as the canonical phrases of LERF, Kerr et al. 2023,
/// section 3.3).
const NEGATIVES: [&str; 4] = ["object", "things", "texture", "background"];

/// What is embedded for a text.
pub(super) fn prompt(what: &str) -> String {
    format!("{PROMPT}{what}")
}

/// What is embedded for the texts that describe anything.
pub(super) fn negatives() -> Vec<String> {
    NEGATIVES.map(prompt).to_vec()
}
