//! Hashes of files.

use segwild_files::open_plain;
use std::io::Result;
use std::path::Path;

/// The BLAKE3 of a file's bytes, as 64 hexadecimal digits; an empty file has one like any other. The file is read in pieces.
///
/// ```
/// # let folder = tempfile::tempdir()?;
/// let path = folder.path().join("photo.jpg");
/// std::fs::write(&path, b"bytes")?;
/// assert_eq!(segwild_scene::file_digest(&path)?, blake3::hash(b"bytes").to_hex().as_str());
/// assert!(segwild_scene::file_digest(folder.path()).is_err());
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// # Errors
/// When it cannot be read, or is a pipe, a device or a folder.
pub fn file_digest(path: &Path) -> Result<String> {
    let mut hasher = blake3::Hasher::new();
    hash_file(&mut hasher, path)?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// Adds a file's bytes to a hash, read in pieces. Two files one after the other have the hash of their bytes together.
///
/// ```
/// # let folder = tempfile::tempdir()?;
/// let path = folder.path().join("photo.jpg");
/// std::fs::write(&path, b"bytes")?;
/// let mut hasher = blake3::Hasher::new();
/// segwild_scene::hash_file(&mut hasher, &path)?;
/// segwild_scene::hash_file(&mut hasher, &path)?;
/// assert_eq!(hasher.finalize(), blake3::hash(b"bytesbytes"));
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// # Errors
/// When it cannot be read, or is a pipe, a device or a folder.
pub fn hash_file(hasher: &mut blake3::Hasher, path: &Path) -> Result<()> {
    hasher.update_reader(open_plain(path)?).map(drop)
}
