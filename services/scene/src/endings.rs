//! Endings of the names of photos, of those that are read and of those that have to be converted.

use std::path::Path;

/// Endings of images that are read, in small letters and best first: the one list of them.
pub(crate) const READ: [&str; 7] = ["png", "tif", "tiff", "jpg", "jpeg", "webp", "bmp"];
/// The same in capitals.
pub(crate) const CAPITALS: [&str; 7] = ["PNG", "JPG", "TIF", "TIFF", "JPEG", "WEBP", "BMP"];
/// Endings of photos that are not read and that have to be converted.
pub(crate) const AVIF: [&str; 2] = ["avif", "avifs"];
pub(crate) const HEIC: [&str; 3] = ["heic", "heif", "hif"];
pub(crate) const RAW: [&str; 15] =
    ["cr2", "cr3", "crw", "nef", "nrw", "dng", "arw", "srf", "sr2", "raf", "orf", "rw2", "pef", "srw", "x3f"];
pub(crate) const JXL: [&str; 1] = ["jxl"];
pub(crate) const JPEG_2000: [&str; 3] = ["jp2", "j2k", "jpx"];

/// Whether a file's ending is that of a photo, be it one that is read or not.
pub(crate) fn is_photo(path: &Path) -> bool {
    let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let lists: [&[&str]; 6] = [&READ, &AVIF, &HEIC, &RAW, &JXL, &JPEG_2000];
    lists.iter().any(|list| list.contains(&ending.as_str()))
}
