//! Settings of earlier versions: renamed, or gone.

/// Settings of earlier versions, and what they are called now.
const RENAMED: [(&str, &str); 8] = [
    ("look", "appearance_model"),
    ("lr_look", "lr_appearance"),
    ("lr_code", "lr_splat_embedding"),
    ("codes_from", "splat_embedding_from"),
    ("strangers", "transient_masks"),
    ("strangers_network", "transient_network"),
    ("train_on", "continue_share"),
    ("object_look", "object_appearance"),
];

/// Settings of earlier versions that are gone, each with the value at which it did what is always done now. Run folders have
/// every setting in their file.
const REMOVED: [(&str, &str); 3] =
    [("seen", "0"), ("centre_visible", "false"), ("graph_cut_smoothness", "1")];

/// Whether a setting is gone and has the value at which it did what is always done now.
pub(crate) fn is_removed(name: &str, value: &str) -> bool {
    REMOVED.contains(&(name, value.trim_end_matches(".0")))
}

/// What a setting of an earlier version is called now; dashes and underscores are the same.
pub fn renamed(name: &str) -> Option<&'static str> {
    let name = name.replace('-', "_");
    RENAMED.iter().find(|(before, _)| *before == name).map(|(_, now)| *now)
}
