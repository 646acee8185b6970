//! The page's files, part of the program.

use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};

/// A file of the page.
struct PageFile {
    name: &'static str,
    kind: &'static str,
    bytes: &'static [u8],
}

macro_rules! files {
    ($($name:literal: $kind:expr),* $(,)?) => {
        &[$(PageFile { name: $name, kind: $kind, bytes: include_bytes!(concat!("page/", $name)) }),*]
    };
}

const SCRIPT: &str = "text/javascript; charset=utf-8";

const FILES: &[PageFile] = files! {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "icon.svg": "image/svg+xml",
    "main.js": SCRIPT,
    "api.js": SCRIPT,
    "budget.js": SCRIPT,
    "farm.js": SCRIPT,
    "geometry.js": SCRIPT,
    "objects.js": SCRIPT,
    "overlay.js": SCRIPT,
    "photos.js": SCRIPT,
    "scene.js": SCRIPT,
    "shortcuts.js": SCRIPT,
    "splats.js": SCRIPT,
    "status.js": SCRIPT,
    "strings.js": SCRIPT,
    "tables.js": SCRIPT,
    "tools.js": SCRIPT,
    "training.js": SCRIPT,
};

/// A file of the page by its name.
pub(crate) fn file(name: &str) -> Response {
    match FILES.iter().find(|file| file.name == name) {
        Some(file) => ([(header::CONTENT_TYPE, file.kind)], file.bytes).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes that the whole page may have.
    const MOST: usize = 170_000;

    #[test]
    fn the_page_is_small_and_fetches_nothing_from_elsewhere() {
        let all: usize = FILES.iter().map(|file| file.bytes.len()).sum();
        assert!(all < MOST, "{all} bytes");
        for file in FILES {
            let text = std::str::from_utf8(file.bytes).expect("text");
            // The name of SVG's language is no address.
            let text = text.replace("http://www.w3.org/2000/svg", "");
            assert!(!text.contains("http:") && !text.contains("https:"), "{}", file.name);
        }
    }
}
