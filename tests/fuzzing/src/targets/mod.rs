//! The readers, by the crate that they belong to.

mod many;
mod networks;
mod photos;
mod records;
mod run_files;
mod scenes;
mod server;
mod vision;

use crate::FuzzTarget;

/// Every reader.
pub const TARGETS: &[FuzzTarget] = &[
    scenes::CAMERAS_BIN,
    scenes::IMAGES_BIN,
    scenes::POINTS_BIN,
    scenes::CAMERAS_TXT,
    scenes::IMAGES_TXT,
    scenes::POINTS_TXT,
    scenes::TRANSFORMS,
    scenes::SPLIT,
    scenes::PLY_SPLATS,
    scenes::PLY_POINTS,
    scenes::IMPORTED_SPLATS,
    scenes::GLB_SPLATS,
    scenes::SOG_SPLATS,
    scenes::SPLAT,
    photos::PNG,
    photos::JPEG,
    photos::WEBP,
    photos::TIFF,
    photos::BMP,
    photos::MASK,
    run_files::SETTINGS,
    run_files::PROMPTS,
    run_files::SCENE_JSON,
    run_files::HISTORY,
    run_files::LEDGER,
    run_files::RESULTS,
    run_files::PARTS,
    records::MODEL,
    records::FEATURES,
    records::SELECTION,
    records::CHECKPOINT,
    records::CACHED_MASKS,
    records::CACHED_EMBEDDING,
    many::MANIFEST,
    many::BATCH,
    many::FARM_RECORD,
    many::FARM_FOLDER,
    networks::ONNX,
    networks::LPIPS,
    server::REQUEST,
    vision::CALL,
    vision::CLIP,
];
