//! Files of a scene as bytes.

use std::path::Path;

/// Most bytes of a file of a scene that is read whole: models of ten thousand photos take a few GiB.
const SCENE_FILE: u64 = 16 << 30;

/// All bytes of a plain file of a scene.
pub(crate) fn read_bytes(path: &Path) -> std::io::Result<Vec<u8>> {
    segwild_files::read_within(path, SCENE_FILE)
}
