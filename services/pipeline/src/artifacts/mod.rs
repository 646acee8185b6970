//! What a run keeps on disk: its folder, the content cache and its keys, checkpoints, timelines.

pub(crate) mod auto_choice;
pub(crate) mod blocks;
pub(crate) mod cache;
pub(crate) mod cameras;
pub(crate) mod checkpoints;
pub(crate) mod described;
pub(crate) mod digests;
pub(crate) mod folder;
pub(crate) mod history;
pub(crate) mod images;
pub(crate) mod intact;
pub(crate) mod keys;
pub(crate) mod lpips;
pub(crate) mod photo_boundaries;
pub(crate) mod photo_cache;
pub(crate) mod prompts;
pub(crate) mod recompute;
pub(crate) mod region_cache;
pub(crate) mod scene_tree;
pub(crate) mod seams;
pub(crate) mod selected;
pub(crate) mod traces;
